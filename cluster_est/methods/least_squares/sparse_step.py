"""The damped Gauss-Newton step within bounds, from a Jacobian that is factored part by part.

Unknowns of one part alone are eliminated from its rows by orthogonal factorisations; what remains
of all parts is solved together for the unknowns that they share, and the others follow by back
substitution (A. Bjorck, Numerical Methods for Least Squares Problems (1996),
doi:10.1137/1.9781611971484, section 6.3). Symbols: J the Jacobian, r the residuals, D the scaling,
p the step, lambda the damping.

Bounds are kept by a sequence of such solutions (block principal pivoting): unknowns that leave
their bounds are fixed there, and fixed ones whose multiplier has the wrong sign are freed, all at
once as long as that lessens their number, else one at a time, which ends after finitely many rounds
(J. J. Judice, F. M. Pires, Comput. Oper. Res. 21 (1994) 587-596,
doi:10.1016/0305-0548(94)90106-6). A round costs the same however many unknowns change, so it suits
problems of thousands of unknowns.

Parts may also be chained: segments of a record share the states that one begins with, which stand
in its own rows and in those of the one before. The rows of a part and what the parts before have
left are then factorised together, which eliminates the unknowns that stand in no later part; what
remains is handed on. So work and memory grow linearly with the number of parts, and no normal
equations are formed, which would square the condition (sequential orthogonal factorisation: G. J.
Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter IV; for multiple
shooting see H. G. Bock, K. J. Plitt, IFAC Proc. Vol. 17 (1984) 1603-1608,
doi:10.1016/S1474-6670(17)61205-9).
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
"""Rounds after which the last minimum is moved into the bounds instead."""
PATIENCE = 5
"""Rounds without fewer infeasibilities, before one unknown changes at a time."""
ROUNDING_OF_GRADIENT = 1e-14
"""Part of the terms of a gradient that is rounding: a component below it has no sign."""

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


@dataclass(frozen=True)
class ChainLink:
    """One block of a chain.

    Attributes
    ----------
    columns : (eliminated + handed on + border,)
        Unknowns: those that no later block has, those that the next one has, then the chain's
        border.
    eliminated, handed
        How many of each.
    arrived
        How many of `eliminated`, at its beginning, the block before has handed on.
    triangle : (m, columns + 1)
        Triangular factor of its Jacobian and residuals.
    """

    columns: IntArray
    eliminated: int
    handed: int
    arrived: int
    triangle: FloatArray = field(repr=False)

    def products(self, step: FloatArray) -> FloatArray:
        """(m,): J p + r, multiplied by an orthogonal matrix."""
        return np.asarray(self.triangle[:, :-1] @ step[self.columns] + self.triangle[:, -1])


@dataclass(frozen=True)
class Chain:
    """Blocks that follow each other, and the border: unknowns that are not eliminated along them.

    Attributes
    ----------
    links
        In their order.
    border
        Unknowns that any of them shares with others.
    """

    links: tuple[ChainLink, ...]
    border: IntArray


@dataclass(frozen=True)
class EliminatedChain:
    """A chain after the elimination.

    Attributes
    ----------
    chain
        Which one.
    rows
        For each link (eliminated, columns + 1): the rows that hold its eliminated unknowns.
    rest : (k, border + 1)
        All information on the border.
    """

    chain: Chain
    rows: tuple[FloatArray, ...] = field(repr=False)
    rest: FloatArray = field(repr=False)

    def substitute(self, step: FloatArray, border: FloatArray, right: float) -> None:
        """Fill in the eliminated unknowns of a step whose border is given.

        Parameters
        ----------
        step : (unknowns,)
            Is filled in.
        border : (border,)
            Values of the chain's border.
        right
            1 for the residuals' part of the solution, 0 for the response to the border alone.
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
        Unknowns that stay; every other one acts on one block, or on two that follow each other.
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
    """The triangular factor of a block and its residuals, with its columns in an order."""
    place = np.full(matrix.size, -1)
    place[order] = np.arange(len(order))
    rows = matrix.rows[e]
    joined = np.zeros((rows.stop - rows.start, len(order) + 1))
    joined[:, place[matrix.columns[e]]] = matrix.blocks[e]
    joined[:, -1] = residuals[rows]
    return np.asarray(np.linalg.qr(joined, mode="r"))


def eliminate(chain: Chain, fixed: Mask, values: FloatArray, roots: FloatArray) -> EliminatedChain:
    """Eliminate all but the border, with damping.

    Parameters
    ----------
    chain
        Which one.
    fixed, values : (unknowns,)
        Unknowns that are not free, and their values: their columns count as zero, and the
        residuals contain their effect.
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
