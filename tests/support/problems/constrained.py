"""Problems of the collection of Hock and Schittkowski, numbered as there, with their minima."""

from collections.abc import Callable, Sequence

import numpy as np
from support.problems.functions import FunctionProblem

from cluster_est.problem.costs import Cost, SumSquared, TotalCost

ROOT2, ROOT3, ROOT7 = np.sqrt([2.0, 3.0, 7.0])
TOTAL = TotalCost()
"""For an objective that is no sum of squares."""
Formula = Callable[[np.ndarray], object]


def held(
    name: str,
    residuals: Formula,
    start: tuple[float, ...],
    minimum: float = np.nan,
    *,
    least: Sequence[Formula] = (),
    equal: Sequence[Formula] = (),
    cost: Cost | None = None,
    **more,
) -> FunctionProblem:
    """Make a problem with constraints that must be at most 0, and others that must be 0.

    Formulas may give lists or numbers.
    """
    both = [*least, *equal]
    if both:
        more["constraints"] = lambda x: np.array([each(x) for each in both], np.float64)
    return FunctionProblem(
        name,
        lambda x: np.atleast_1d(np.asarray(residuals(x), np.float64)),
        start,
        minimum,
        equality=(False,) * len(least) + (True,) * len(equal),
        cost=cost or SumSquared(),
        **more,
    )


def hs(named, residuals: Formula, *, box=(None, None), **more) -> FunctionProblem:
    """Make a problem of the collection from its name, start and minimum, and all the rest."""
    return held(named[0], residuals, *named[1:], lower=box[0], upper=box[1], **more)


def objective(named, formula: Formula, **more) -> FunctionProblem:
    """Make one whose objective is no sum of squares."""
    return hs(named, formula, cost=TOTAL, **more)


def quadratic(constant, slope, matrix) -> Formula:
    """c + g'x + x'Qx."""
    return lambda x: constant + np.dot(slope, x) + x @ np.array(matrix) @ x


CONSTRAINED = [
    objective(
        ("hs5 bounds only", (0.0, 0.0), -ROOT3 / 2.0 - np.pi / 3.0),
        lambda x: np.sin(x[0] + x[1]) + (x[0] - x[1]) ** 2 - 1.5 * x[0] + 2.5 * x[1] + 1.0,
        box=((-1.5, -3.0), (4.0, 3.0)),
    ),
    hs(
        ("hs6", (-1.2, 1.0), 0.0), lambda x: 1.0 - x[0], equal=[lambda x: 10.0 * (x[1] - x[0] ** 2)]
    ),
    objective(
        ("hs7", (2.0, 2.0), -ROOT3),
        lambda x: np.log(1.0 + x[0] ** 2) - x[1],
        equal=[lambda x: (1.0 + x[0] ** 2) ** 2 + x[1] ** 2 - 4.0],
    ),
    objective(
        ("hs11", (4.9, 0.1), -8.498464223),
        lambda x: (x[0] - 5.0) ** 2 + x[1] ** 2 - 25.0,
        least=[lambda x: x[0] ** 2 - x[1]],
    ),
    hs(
        ("hs14", (2.0, 2.0), 9.0 - 2.875 * ROOT7),
        lambda x: [x[0] - 2.0, x[1] - 1.0],
        least=[lambda x: 0.25 * x[0] ** 2 + x[1] ** 2 - 1.0],
        equal=[lambda x: x[0] - 2.0 * x[1] + 1.0],
    ),
    hs(
        ("hs15", (-2.0, 1.0), 306.5),
        lambda x: [10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]],
        box=((-np.inf, -np.inf), (0.5, np.inf)),
        least=[lambda x: 1.0 - x[0] * x[1], lambda x: -x[0] - x[1] ** 2],
    ),
    hs(
        ("hs26", (-2.6, 2.0, 2.0), 0.0),
        lambda x: [x[0] - x[1], (x[1] - x[2]) ** 2],
        equal=[lambda x: (1.0 + x[1] ** 2) * x[0] + x[2] ** 4 - 3.0],
    ),
    objective(
        ("hs35", (0.5, 0.5, 0.5), 1.0 / 9.0),
        quadratic(9.0, [-8.0, -6.0, -4.0], [[2.0, 1.0, 1.0], [1.0, 2.0, 0.0], [1.0, 0.0, 1.0]]),
        box=((0.0, 0.0, 0.0), (np.inf, np.inf, np.inf)),
        least=[lambda x: x[0] + x[1] + 2.0 * x[2] - 3.0],
    ),
    objective(
        ("hs40", (0.8, 0.8, 0.8, 0.8), -0.25),
        lambda x: -np.prod(x),
        equal=[
            lambda x: x[0] ** 3 + x[1] ** 2 - 1.0,
            lambda x: x[0] ** 2 * x[3] - x[2],
            lambda x: x[3] ** 2 - x[1],
        ],
    ),
    objective(
        ("hs43 Rosen-Suzuki", (0.0, 0.0, 0.0, 0.0), -44.0),
        quadratic(0.0, [-5.0, -5.0, -21.0, 7.0], np.diag([1.0, 1.0, 2.0, 1.0])),
        least=[
            quadratic(-8.0, [1.0, -1.0, 1.0, -1.0], np.eye(4)),
            quadratic(-10.0, [-1.0, 0.0, 0.0, -1.0], np.diag([1.0, 2.0, 1.0, 2.0])),
            quadratic(-5.0, [2.0, -1.0, 0.0, -1.0], np.diag([2.0, 1.0, 1.0, 0.0])),
        ],
    ),
    hs(
        ("hs48", (3.0, 5.0, -3.0, 2.0, -2.0), 0.0),
        lambda x: [x[0] - 1.0, x[1] - x[2], x[3] - x[4]],
        equal=[lambda x: np.add.reduce(x) - 5.0, lambda x: x[2] - 2.0 * (x[3] + x[4]) + 3.0],
    ),
    # published start (-5, 5, 0), which is outside the bounds
    hs(
        ("hs65", (-4.5, 4.5, 0.0), 0.9535288567),
        lambda x: [x[0] - x[1], (x[0] + x[1] - 10.0) / 3.0, x[2] - 5.0],
        box=((-4.5, -4.5, -5.0), (4.5, 4.5, 5.0)),
        least=[lambda x: x @ x - 48.0],
    ),
    objective(
        ("hs71", (1.0, 5.0, 5.0, 1.0), 17.0140173),
        lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        box=((1.0, 1.0, 1.0, 1.0), (5.0, 5.0, 5.0, 5.0)),
        least=[lambda x: 25.0 - np.prod(x)],
        equal=[lambda x: x @ x - 40.0],
    ),
    hs(
        ("hs77", (2.0, 2.0, 2.0, 2.0, 2.0), 0.24150513),
        lambda x: [x[0] - 1.0, x[0] - x[1], x[2] - 1.0, (x[3] - 1.0) ** 2, (x[4] - 1.0) ** 3],
        equal=[
            lambda x: x[0] ** 2 * x[3] + np.sin(x[3] - x[4]) - 2.0 * ROOT2,
            lambda x: x[1] + x[2] ** 4 * x[3] ** 2 - 8.0 - ROOT2,
        ],
    ),
    hs(
        ("hs79", (2.0, 2.0, 2.0, 2.0, 2.0), 0.0787768209),
        lambda x: [x[0] - 1.0, x[0] - x[1], x[1] - x[2], (x[2] - x[3]) ** 2, (x[3] - x[4]) ** 2],
        equal=[
            lambda x: x[0] + x[1] ** 2 + x[2] ** 3 - 2.0 - 3.0 * ROOT2,
            lambda x: x[1] - x[2] ** 2 + x[3] + 2.0 - 2.0 * ROOT2,
            lambda x: x[0] * x[4] - 2.0,
        ],
    ),
]
"""From W. Hock, K. Schittkowski, Test Examples for Nonlinear Programming Codes, Lecture Notes in
Economics and Mathematical Systems 187 (1981), doi:10.1007/978-3-642-48320-2."""
