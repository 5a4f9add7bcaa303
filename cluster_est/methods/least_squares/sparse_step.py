"""The damped Gauss-Newton step within bounds, from a Jacobian that is factored part by part.

Symbols: J the Jacobian, r the residuals, D the scaling, p the step, lambda the damping.

Orthogonal factorisations of the rows of a part eliminate the unknowns of this part alone. The
remaining rows of all parts are solved together for the shared unknowns. The other unknowns follow
by back substitution (A. Bjorck, Numerical Methods for Least Squares Problems (1996),
doi:10.1137/1.9781611971484, section 6.3).

A sequence of such solutions keeps the bounds (block principal pivoting). Unknowns outside their
bounds are fixed at the bounds. Fixed unknowns are freed if their multiplier has the wrong sign.
All these unknowns change at once while their number decreases, and one at a time otherwise. The
sequence is finite (J. J. Judice, F. M. Pires, Comput. Oper. Res. 21 (1994) 587-596,
doi:10.1016/0305-0548(94)90106-6). The cost of a round does not depend on the number of changes, so
the method suits thousands of unknowns.

Parts may also form a chain, as segments of a record do. The initial states of a segment occur in
its own rows and in the rows of the previous segment. The rows of a part are factorised together
with the rows that remain from the previous parts. This eliminates the unknowns that occur in no
later part, and the remaining rows pass to the next part. Work and memory grow linearly with the
number of parts. The method avoids normal equations, which square the condition number (sequential
orthogonal factorisation: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation
(1977), chapter IV; for multiple shooting see H. G. Bock, K. J. Plitt, IFAC Proc. Vol. 17 (1984)
1603-1608, doi:10.1016/S1474-6670(17)61205-9).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Protocol, final

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from workers.messages import FloatArray, IntArray

ACTIVE_SET_ROUNDS = 60
"""Largest number of rounds; the last solution is then clipped to the bounds."""
PATIENCE = 5
"""Rounds without fewer infeasibilities, before one unknown changes at a time."""
ROUNDING_OF_GRADIENT = 1e-14
"""Rounding error of a gradient, relative to its terms; smaller components count as zero."""

Solve = Callable[[npt.NDArray[np.bool_], FloatArray], FloatArray]
Gradient = Callable[[FloatArray], tuple[FloatArray, float]]


def within_bounds(
    solve: Solve,
    gradient: Gradient,
    lower: FloatArray,
    upper: FloatArray,
    rounds: int = ACTIVE_SET_ROUNDS,
) -> FloatArray:
    """Return the minimum (unknowns,) within bounds.

    Parameters
    ----------
    solve
        Function of a mask of the fixed unknowns and their values. It returns the minimum over the
        other unknowns.
    gradient
        Function of a point. It returns the gradient, in units in which curvatures are about 1, and
        the size of its terms.
    lower, upper : (unknowns,)
        Bounds; they may be equal.
    rounds
        Largest number of rounds.
    """
    count = len(lower)
    equal = upper <= lower
    active = np.where(equal, -1, 0)  # -1: at the lower bound, 1: at the upper bound, 0: free
    fewest, patience = count + 1, PATIENCE
    x = np.zeros(count)
    for _ in range(rounds):
        bound = np.where(active < 0, lower, upper)
        x = solve(active != 0, np.where(active != 0, bound, 0.0))
        wanted = np.where(active == 0, np.where(x < lower, -1, np.where(x > upper, 1, 0)), active)
        if (active != 0).any():
            g, size = gradient(x)
            wanted = np.where((active * g > ROUNDING_OF_GRADIENT * size) & ~equal, 0, wanted)
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
        """Yield J p + r part by part, each part multiplied by an orthogonal matrix."""

    @abstractmethod
    def solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the minimum of the damped model, with given values of its fixed unknowns.

        Parameters
        ----------
        fixed, values : (unknowns,)
            Mask of the fixed unknowns, and their values.
        roots : (unknowns,)
            sqrt(lambda) D.
        """

    @abstractmethod
    def gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        """Return half the gradient of the damped model, and the size of its terms."""


class Factor(Protocol):
    """A function that factors a Jacobian and residuals."""

    def __call__(self, matrix: BlockMatrix, residuals: FloatArray) -> FactoredJacobian: ...


def powers_of_two(sizes: FloatArray) -> FloatArray:
    """Return the power of two next to each size, and 1 for a size of zero."""
    return np.asarray(2.0 ** np.round(np.log2(np.where(sizes > 0.0, sizes, 1.0))), np.float64)


@final
class SparseStepSolver:
    """Solver that minimises |J p + r|^2 + lambda |D p|^2 subject to lower <= p <= upper.

    Parameters
    ----------
    factor
        Function that factors J and r.
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
        # powers of two bring the columns to one size without rounding
        self._units = powers_of_two(scale)
        self._scale = scale / self._units
        self._lower, self._upper = lower * self._units, upper * self._units
        self._factored = factor(matrix.divided_columns(self._units), residuals)

    def step(self, damping: float) -> FloatArray:
        """Return the step for lambda above 0; it is zero for unknowns without effect."""
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
    """Return the shared unknowns from the rows that remain after elimination; 0 for fixed ones.

    Parameters
    ----------
    shared
        Indices of the shared unknowns, in ascending order.
    roots : (unknowns,)
        sqrt(lambda) D.
    parts
        Indices of the shared unknowns of each part, and its remaining rows (k, these + 1). The last
        column holds the residuals.
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


@dataclass(frozen=True)
class ChainLink:
    """One block of a chain.

    Attributes
    ----------
    columns : (eliminated + handed on + border,)
        Indices of unknowns: first the unknowns that no later block has, then the unknowns that the
        next block has, then the border of the chain.
    eliminated, handed
        Number of unknowns in the first and in the second group.
    arrived
        Number of unknowns from the previous block, at the beginning of the first group.
    triangle : (m, columns + 1)
        Triangular factor of the block's Jacobian and residuals.
    """

    columns: IntArray
    eliminated: int
    handed: int
    arrived: int
    triangle: FloatArray = field(repr=False)

    def products(self, step: FloatArray) -> FloatArray:
        """Return J p + r (m,), multiplied by an orthogonal matrix."""
        return np.asarray(self.triangle[:, :-1] @ step[self.columns] + self.triangle[:, -1])


@dataclass(frozen=True)
class Chain:
    """Consecutive blocks, and the border: unknowns that are not eliminated along the chain.

    Attributes
    ----------
    links
        The blocks, in their order.
    border
        Indices of the border unknowns that occur in the chain.
    """

    links: tuple[ChainLink, ...]
    border: IntArray


@dataclass(frozen=True)
class EliminatedChain:
    """A chain after the elimination.

    Attributes
    ----------
    chain
        The chain.
    rows
        Rows of each link for its eliminated unknowns, (eliminated, columns + 1).
    rest : (k, border + 1)
        The remaining rows, which contain only the border and the residuals.
    """

    chain: Chain
    rows: tuple[FloatArray, ...] = field(repr=False)
    rest: FloatArray = field(repr=False)

    def substitute(self, step: FloatArray, border: FloatArray, right: float) -> None:
        """Set the eliminated unknowns of a step by back substitution.

        Parameters
        ----------
        step : (unknowns,)
            The step, which is modified in place.
        border : (border,)
            Values of the chain's border.
        right
            1 to include the residuals, 0 for the response to the border alone.
        """
        following = np.zeros(0)
        for link, rows in zip(reversed(self.chain.links), reversed(self.rows), strict=True):
            known = np.concatenate([following, border, [right]])
            values = -(rows[:, link.eliminated :] @ known)
            for j in reversed(range(link.eliminated)):
                above = values[j] - rows[j, j + 1 : link.eliminated] @ values[j + 1 :]
                pivot = rows[j, j]
                values[j] = above / pivot if pivot != 0.0 else 0.0
            step[link.columns[: link.eliminated]] = values
            following = values[: link.arrived]


def make_chains(matrix: BlockMatrix, residuals: FloatArray, border: Mask) -> list[Chain]:
    """Order the columns of each block, factorise its rows, and join blocks to chains.

    Parameters
    ----------
    matrix, residuals
        J and r.
    border : (unknowns,)
        Mask of the border unknowns. Every other unknown acts on one block, or on two consecutive
        blocks.
    """
    last = np.full(matrix.size, -1)
    for e, columns in enumerate(matrix.columns):
        last[columns] = e
    inner = [columns[~border[columns]] for columns in matrix.columns]
    handed = [columns[last[columns] > e] for e, columns in enumerate(inner)]
    nothing = np.zeros(0, np.intp)
    found: list[Chain] = []
    members: list[int] = []
    for e in range(len(inner)):
        members.append(e)
        if len(handed[e]):
            continue
        shared = [matrix.columns[m][border[matrix.columns[m]]] for m in members]
        common = np.unique(np.concatenate([nothing, *shared]))
        links = []
        for m in members:
            arrived = nothing if m == members[0] else handed[m - 1]
            ending = np.setdiff1d(inner[m], np.concatenate([arrived, handed[m]]))
            eliminated = np.concatenate([arrived, ending])
            order = np.concatenate([eliminated, handed[m], common])
            counts = len(eliminated), len(handed[m]), len(arrived)
            links.append(ChainLink(order, *counts, _triangle(matrix, residuals, m, order)))
        found.append(Chain(tuple(links), common))
        members = []
    return found


def _triangle(matrix: BlockMatrix, residuals: FloatArray, e: int, order: IntArray) -> FloatArray:
    """Return the triangular factor of a block and its residuals, with the columns in an order."""
    place = np.full(matrix.size, -1)
    place[order] = np.arange(len(order))
    rows = matrix.rows[e]
    joined = np.zeros((rows.stop - rows.start, len(order) + 1))
    joined[:, place[matrix.columns[e]]] = matrix.blocks[e]
    joined[:, -1] = residuals[rows]
    return np.asarray(np.linalg.qr(joined, mode="r"))


def eliminate(chain: Chain, fixed: Mask, values: FloatArray, roots: FloatArray) -> EliminatedChain:
    """Eliminate all unknowns of a chain except the border, with damping.

    Parameters
    ----------
    chain
        The chain.
    fixed, values : (unknowns,)
        Mask of the fixed unknowns, and their values. Their columns count as zero, and the residuals
        contain their effect.
    roots : (unknowns,)
        sqrt(lambda) D.
    """
    kept: list[FloatArray] = []
    carried = np.zeros((0, len(chain.border) + 1))
    given = np.where(fixed, values, 0.0)
    for link in chain.links:
        width = len(link.columns) + 1
        rows, arrived, n = len(carried), link.arrived, link.eliminated
        system = np.zeros((rows + len(link.triangle) + n, width))
        system[:rows, :arrived] = carried[:, :arrived]
        system[:rows, n + link.handed :] = carried[:, arrived:]
        own = system[rows : rows + len(link.triangle)]
        own[:, :-1] = link.triangle[:, :-1] * ~fixed[link.columns]
        own[:, -1] = link.products(given)
        diagonal = np.arange(n)
        system[rows + len(link.triangle) + diagonal, diagonal] = roots[link.columns[:n]]
        triangle = np.asarray(np.linalg.qr(system, mode="r"))
        if len(triangle) < n:
            triangle = np.vstack([triangle, np.zeros((n - len(triangle), width))])
        kept.append(triangle[:n])
        carried = triangle[n:, n:]
    return EliminatedChain(chain, tuple(kept), carried)
