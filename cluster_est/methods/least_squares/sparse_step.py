"""The damped Gauss-Newton step within bounds, from a Jacobian that is factored part by part.

Unknowns of one part alone are eliminated from its rows by orthogonal factorisations; what remains
of all parts is solved together for the unknowns that they share, and the others follow by back
substitution (A. Bjorck, Numerical Methods for Least Squares Problems (1996),
doi:10.1137/1.9781611971484, section 6.3). Symbols: J the Jacobian, r the residuals, D the scaling,
p the step, lambda the damping.

The minimum of a strictly convex quadratic function within bounds, from unbounded minima.

Unknowns that leave their bounds are fixed there, and fixed ones whose multiplier has the wrong sign
are freed, all at once as long as that lessens their number, else one at a time, which ends after
finitely many rounds (block principal pivoting): J. J. Judice, F. M. Pires, Comput. Oper. Res. 21
(1994) 587-596, doi:10.1016/0305-0548(94)90106-6. A round costs the same however many unknowns
change, so it suits problems of thousands of unknowns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, final

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from workers.messages import FloatArray, IntArray

ROUNDS = 60
"""After which the last minimum is moved into the bounds instead."""
PATIENCE = 5
"""Rounds without fewer infeasibilities, before one unknown changes at a time."""
ROUNDING = 1e-14
"""Of the terms of a gradient: less of it has no sign."""

Solve = Callable[[npt.NDArray[np.bool_], FloatArray], FloatArray]
Gradient = Callable[[FloatArray], tuple[FloatArray, float]]


def within_bounds(
    solve: Solve, gradient: Gradient, lower: FloatArray, upper: FloatArray, rounds: int = ROUNDS
) -> FloatArray:
    """Return the minimum (unknowns,) within bounds.

    Parameters
    ----------
    solve
        From a mask of the fixed unknowns and their values: the minimum over the others.
    gradient
        From a point: the gradient there, in units in which curvatures are about 1, and the size of
        its terms.
    lower, upper : (unknowns,)
        They may be the same.
    """
    count = len(lower)
    equal = upper <= lower
    active = np.where(equal, -1, 0)  # -1 and 1 for the bounds, 0 for between them
    fewest, patience = count + 1, PATIENCE
    x = np.zeros(count)
    for _ in range(rounds):
        bound = np.where(active < 0, lower, upper)
        x = solve(active != 0, np.where(active != 0, bound, 0.0))
        wanted = np.where(active == 0, np.where(x < lower, -1, np.where(x > upper, 1, 0)), active)
        if (active != 0).any():
            g, size = gradient(x)
            wanted = np.where((active * g > ROUNDING * size) & ~equal, 0, wanted)
        infeasible = np.flatnonzero(wanted != active)
        if not len(infeasible):
            break
        if len(infeasible) < fewest:
            fewest, patience = len(infeasible), PATIENCE
        else:
            patience -= 1
        changed = infeasible if patience > 0 else infeasible[-1:]
        active[changed] = wanted[changed]
    return np.clip(x, lower, upper)


Mask = npt.NDArray[np.bool_]


class FactoredJacobian(ABC):
    """J and r, factored part by part by orthogonal matrices."""

    @abstractmethod
    def products(self, step: FloatArray) -> Iterator[FloatArray]:
        """Give J p + r, part by part, each multiplied by an orthogonal matrix."""

    @abstractmethod
    def solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the minimum of the damped model, with given values of its fixed unknowns.

        Parameters
        ----------
        fixed, values : (unknowns,)
            Which unknowns are fixed, and their values.
        roots : (unknowns,)
            sqrt(lambda) D.
        """

    @abstractmethod
    def gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        """Return half the gradient of the damped model, and the size of its terms."""


class Factor(Protocol):
    """Factors a Jacobian and residuals."""

    def __call__(self, matrix: BlockMatrix, residuals: FloatArray) -> FactoredJacobian: ...


@final
class SparseStepSolver:
    """Minimises |J p + r|^2 + lambda |D p|^2 subject to lower <= p <= upper.

    Parameters
    ----------
    factor
        How J is factored.
    matrix
        J.
    residuals : (residuals,)
        r.
    scale : (unknowns,)
        D, the diagonal; positive.
    lower, upper : (unknowns,)
        Bounds of the step; 0 lies between them.
    """

    def __init__(
        self,
        factor: Factor,
        matrix: BlockMatrix,
        residuals: FloatArray,
        scale: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
    ) -> None:
        # powers of two bring the columns to one size and change no digit
        self._units = np.asarray(2.0 ** np.round(np.log2(scale)), np.float64)
        self._scale = scale / self._units
        self._lower, self._upper = lower * self._units, upper * self._units
        self._factored = factor(matrix.divided_columns(self._units), residuals)

    def step(self, damping: float) -> FloatArray:
        """Return the step for lambda above 0; it is zero for unknowns without any effect."""
        roots = np.sqrt(damping) * self._scale

        def solve(fixed: Mask, values: FloatArray) -> FloatArray:
            return self._factored.solve(fixed, values, roots)

        def gradient(step: FloatArray) -> tuple[FloatArray, float]:
            return self._factored.gradient(step, roots)

        step = within_bounds(solve, gradient, self._lower, self._upper)
        return np.asarray(step / self._units)

    def predicted_cost(self, step: FloatArray) -> float:
        """Return |J p + r|^2, the cost that the linear model predicts after a step."""
        parts = self._factored.products(step * self._units)
        return float(sum(float(np.add.reduce((part * part).ravel())) for part in parts))


def solve_shared(
    shared: IntArray, roots: FloatArray, parts: Iterable[tuple[IntArray, FloatArray]]
) -> FloatArray:
    """Return the shared unknowns, from the rows that the elimination has left; 0 for fixed ones.

    Parameters
    ----------
    shared
        Which unknowns these are, in ascending order.
    roots : (unknowns,)
        sqrt(lambda) D.
    parts
        Shared unknowns of a part, and its rows (k, these + 1), the last column of which holds the
        residuals.
    """
    count = len(shared)
    if not count:
        return np.zeros(0)
    rows = [np.column_stack([np.diag(roots[shared]), np.zeros(count)])]
    for columns, left in parts:
        part = np.zeros((len(left), count + 1))
        part[:, np.searchsorted(shared, columns)] = left[:, :-1]
        part[:, -1] = left[:, -1]
        rows.append(part)
    joined = np.vstack(rows)
    return np.asarray(np.linalg.lstsq(joined[:, :count], -joined[:, count], rcond=None)[0])
