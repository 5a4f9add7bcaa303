"""Problems of the collection of Hock and Schittkowski, numbered as there, with their minima."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from support.problems.functions import FunctionProblem

from cluster_est.costs.base import Cost

ROOT2, ROOT3, ROOT7 = np.sqrt([2.0, 3.0, 7.0])


@dataclass(frozen=True)
class Total(Cost):
    """F = the sum of the residuals: for an objective that is no sum of squares."""

    name: ClassVar[str] = "total"

    def value(self, residuals, outputs):
        return float(np.add.reduce(residuals))

    def weights(self, residuals, outputs):
        return None


def scalar(function):
    """An objective as the only residual of a `Total`."""
    return lambda x: np.array([function(x)])


def at_most(*functions):
    """Constraints, each a function of x that must be at most 0 (or 0)."""
    return lambda x: np.array([function(x) for function in functions])


LEAST, EQUAL = False, True

CONSTRAINED = [
    FunctionProblem(
        "hs5 bounds only",
        scalar(lambda x: np.sin(x[0] + x[1]) + (x[0] - x[1]) ** 2 - 1.5 * x[0] + 2.5 * x[1] + 1.0),
        (0.0, 0.0),
        -ROOT3 / 2.0 - np.pi / 3.0,
        (-1.5, -3.0),
        (4.0, 3.0),
        cost=Total(),
    ),
    FunctionProblem(
        "hs6",
        lambda x: np.array([1.0 - x[0]]),
        (-1.2, 1.0),
        0.0,
        constraints=at_most(lambda x: 10.0 * (x[1] - x[0] ** 2)),
        equality=(EQUAL,),
    ),
    FunctionProblem(
        "hs7",
        scalar(lambda x: np.log(1.0 + x[0] ** 2) - x[1]),
        (2.0, 2.0),
        -ROOT3,
        constraints=at_most(lambda x: (1.0 + x[0] ** 2) ** 2 + x[1] ** 2 - 4.0),
        equality=(EQUAL,),
        cost=Total(),
    ),
    FunctionProblem(
        "hs11",
        scalar(lambda x: (x[0] - 5.0) ** 2 + x[1] ** 2 - 25.0),
        (4.9, 0.1),
        -8.498464223,
        constraints=at_most(lambda x: x[0] ** 2 - x[1]),
        equality=(LEAST,),
        cost=Total(),
    ),
    FunctionProblem(
        "hs14",
        lambda x: np.array([x[0] - 2.0, x[1] - 1.0]),
        (2.0, 2.0),
        9.0 - 2.875 * ROOT7,
        constraints=at_most(
            lambda x: 0.25 * x[0] ** 2 + x[1] ** 2 - 1.0, lambda x: x[0] - 2.0 * x[1] + 1.0
        ),
        equality=(LEAST, EQUAL),
    ),
    FunctionProblem(
        "hs15",
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        (-2.0, 1.0),
        306.5,
        (-np.inf, -np.inf),
        (0.5, np.inf),
        constraints=at_most(lambda x: 1.0 - x[0] * x[1], lambda x: -x[0] - x[1] ** 2),
        equality=(LEAST, LEAST),
    ),
    FunctionProblem(
        "hs22",
        lambda x: np.array([x[0] - 2.0, x[1] - 1.0]),
        (2.0, 2.0),
        1.0,
        constraints=at_most(lambda x: x[0] + x[1] - 2.0, lambda x: x[0] ** 2 - x[1]),
        equality=(LEAST, LEAST),
    ),
    FunctionProblem(
        "hs26",
        lambda x: np.array([x[0] - x[1], (x[1] - x[2]) ** 2]),
        (-2.6, 2.0, 2.0),
        0.0,
        constraints=at_most(lambda x: (1.0 + x[1] ** 2) * x[0] + x[2] ** 4 - 3.0),
        equality=(EQUAL,),
    ),
    FunctionProblem(
        "hs27",
        lambda x: np.array([0.1 * (x[0] - 1.0), x[1] - x[0] ** 2]),
        (2.0, 2.0, 2.0),
        0.04,
        constraints=at_most(lambda x: x[0] + x[2] ** 2 + 1.0),
        equality=(EQUAL,),
    ),
    FunctionProblem(
        "hs35",
        scalar(
            lambda x: (
                9.0
                - 8.0 * x[0]
                - 6.0 * x[1]
                - 4.0 * x[2]
                + 2.0 * x[0] ** 2
                + 2.0 * x[1] ** 2
                + x[2] ** 2
                + 2.0 * x[0] * x[1]
                + 2.0 * x[0] * x[2]
            )
        ),
        (0.5, 0.5, 0.5),
        1.0 / 9.0,
        (0.0, 0.0, 0.0),
        (np.inf, np.inf, np.inf),
        constraints=at_most(lambda x: x[0] + x[1] + 2.0 * x[2] - 3.0),
        equality=(LEAST,),
        cost=Total(),
    ),
    FunctionProblem(
        "hs39",
        scalar(lambda x: -x[0]),
        (2.0, 2.0, 2.0, 2.0),
        -1.0,
        constraints=at_most(
            lambda x: x[1] - x[0] ** 3 - x[2] ** 2, lambda x: x[0] ** 2 - x[1] - x[3] ** 2
        ),
        equality=(EQUAL, EQUAL),
        cost=Total(),
    ),
    FunctionProblem(
        "hs40",
        scalar(lambda x: -np.prod(x)),
        (0.8, 0.8, 0.8, 0.8),
        -0.25,
        constraints=at_most(
            lambda x: x[0] ** 3 + x[1] ** 2 - 1.0,
            lambda x: x[0] ** 2 * x[3] - x[2],
            lambda x: x[3] ** 2 - x[1],
        ),
        equality=(EQUAL, EQUAL, EQUAL),
        cost=Total(),
    ),
    FunctionProblem(
        "hs42",
        lambda x: x - np.array([1.0, 2.0, 3.0, 4.0]),
        (1.0, 1.0, 1.0, 1.0),
        28.0 - 10.0 * ROOT2,
        constraints=at_most(lambda x: x[0] - 2.0, lambda x: x[2] ** 2 + x[3] ** 2 - 2.0),
        equality=(EQUAL, EQUAL),
    ),
    FunctionProblem(
        "hs43 Rosen-Suzuki",
        scalar(
            lambda x: (
                x[0] ** 2
                + x[1] ** 2
                + 2.0 * x[2] ** 2
                + x[3] ** 2
                - 5.0 * x[0]
                - 5.0 * x[1]
                - 21.0 * x[2]
                + 7.0 * x[3]
            )
        ),
        (0.0, 0.0, 0.0, 0.0),
        -44.0,
        constraints=at_most(
            lambda x: x @ x + x[0] - x[1] + x[2] - x[3] - 8.0,
            lambda x: x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 + 2 * x[3] ** 2 - x[0] - x[3] - 10.0,
            lambda x: 2 * x[0] ** 2 + x[1] ** 2 + x[2] ** 2 + 2 * x[0] - x[1] - x[3] - 5.0,
        ),
        equality=(LEAST, LEAST, LEAST),
        cost=Total(),
    ),
    FunctionProblem(
        "hs48",
        lambda x: np.array([x[0] - 1.0, x[1] - x[2], x[3] - x[4]]),
        (3.0, 5.0, -3.0, 2.0, -2.0),
        0.0,
        constraints=at_most(
            lambda x: np.add.reduce(x) - 5.0, lambda x: x[2] - 2.0 * (x[3] + x[4]) + 3.0
        ),
        equality=(EQUAL, EQUAL),
    ),
    FunctionProblem(
        "hs60",
        lambda x: np.array([x[0] - 1.0, x[0] - x[1], (x[1] - x[2]) ** 2]),
        (2.0, 2.0, 2.0),
        0.03256820025,
        (-10.0, -10.0, -10.0),
        (10.0, 10.0, 10.0),
        constraints=at_most(lambda x: x[0] * (1.0 + x[1] ** 2) + x[2] ** 4 - 4.0 - 3.0 * ROOT2),
        equality=(EQUAL,),
    ),
    # published start (-5, 5, 0), which is outside the bounds
    FunctionProblem(
        "hs65",
        lambda x: np.array([x[0] - x[1], (x[0] + x[1] - 10.0) / 3.0, x[2] - 5.0]),
        (-4.5, 4.5, 0.0),
        0.9535288567,
        (-4.5, -4.5, -5.0),
        (4.5, 4.5, 5.0),
        constraints=at_most(lambda x: x @ x - 48.0),
        equality=(LEAST,),
    ),
    FunctionProblem(
        "hs71",
        scalar(lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2]),
        (1.0, 5.0, 5.0, 1.0),
        17.0140173,
        (1.0, 1.0, 1.0, 1.0),
        (5.0, 5.0, 5.0, 5.0),
        constraints=at_most(lambda x: 25.0 - np.prod(x), lambda x: x @ x - 40.0),
        equality=(LEAST, EQUAL),
        cost=Total(),
    ),
    FunctionProblem(
        "hs77",
        lambda x: np.array(
            [x[0] - 1.0, x[0] - x[1], x[2] - 1.0, (x[3] - 1.0) ** 2, (x[4] - 1.0) ** 3]
        ),
        (2.0, 2.0, 2.0, 2.0, 2.0),
        0.24150513,
        constraints=at_most(
            lambda x: x[0] ** 2 * x[3] + np.sin(x[3] - x[4]) - 2.0 * ROOT2,
            lambda x: x[1] + x[2] ** 4 * x[3] ** 2 - 8.0 - ROOT2,
        ),
        equality=(EQUAL, EQUAL),
    ),
    FunctionProblem(
        "hs79",
        lambda x: np.array(
            [x[0] - 1.0, x[0] - x[1], x[1] - x[2], (x[2] - x[3]) ** 2, (x[3] - x[4]) ** 2]
        ),
        (2.0, 2.0, 2.0, 2.0, 2.0),
        0.0787768209,
        constraints=at_most(
            lambda x: x[0] + x[1] ** 2 + x[2] ** 3 - 2.0 - 3.0 * ROOT2,
            lambda x: x[1] - x[2] ** 2 + x[3] + 2.0 - 2.0 * ROOT2,
            lambda x: x[0] * x[4] - 2.0,
        ),
        equality=(EQUAL, EQUAL, EQUAL),
    ),
]
"""From W. Hock, K. Schittkowski, Test Examples for Nonlinear Programming Codes, Lecture Notes in
Economics and Mathematical Systems 187 (1981), doi:10.1007/978-3-642-48320-2."""
