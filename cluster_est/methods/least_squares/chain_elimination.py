"""Elimination along chains of blocks, each of which shares unknowns with the next one only.

Segments of a record are such a chain: the states that one begins with stand in its own rows and in
those of the one before. The rows of a block and what the blocks before have left are factorised
together, which eliminates the unknowns that stand in no later block; what remains is handed on. So
work and memory grow linearly with the number of blocks, and no normal equations are formed, which
would square the condition (sequential orthogonal factorisation: G. J. Bierman, Factorization
Methods for Discrete Sequential Estimation (1977), chapter IV; for multiple shooting see H. G. Bock,
K. J. Plitt, IFAC Proc. Vol. 17 (1984) 1603-1608, doi:10.1016/S1474-6670(17)61205-9).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.sparse_step import Mask
from workers.messages import FloatArray, IntArray


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
        Those that stay; every other one acts on one block, or on two that follow each other.
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
