"""The solution of one search on segments, and what its derivatives say."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import fdtrc

from cluster_est.methods.base import Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.chain_elimination import eliminate, make_chains
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class SegmentSolution:
    """The solution of a search on segments.

    Attributes
    ----------
    space
        With the weight of the search, starting at the solution.
    solution
        Of the search.
    jumps : (ends,)
        Differences between the end of a segment and the start of the next, in units of the states.
    spread : (states,)
        Of each state.
    """

    space: SearchSpace
    solution: Solution
    jumps: FloatArray = field(repr=False)
    spread: FloatArray

    @classmethod
    def of(cls, space: SearchSpace, solution: Solution, spread: FloatArray) -> SegmentSolution:
        """Return the solution of a search of a space."""
        return cls(space.starting_at(solution.x), solution, _jumps(space, solution), spread)

    @property
    def works(self) -> bool:
        """Whether its point could be simulated."""
        return self.solution.at is not None and self.solution.at.ok

    @property
    def largest_jump(self) -> float:
        """Over the spread of the state; NaN where nothing could be simulated."""
        relative = np.abs(self.jumps) / np.resize(self.spread, len(self.jumps))
        return float(np.max(relative, initial=0.0))

    @property
    def data_cost(self) -> float:
        """The sum of squares without that of the differences between segments."""
        continuity = self.space.continuity
        assert continuity is not None
        counted = continuity.weight * self.jumps / continuity.scales
        return float(self.solution.cost - np.add.reduce(counted * counted))

    @property
    def variance(self) -> float:
        """Of the residuals of measured values; each state at an end takes one unknown with it."""
        assert self.space.continuity is not None
        count = len(self.space.continuity.ends)
        measured = self.space.rows[-1].stop - count
        return float(self.data_cost / max(measured - (self.space.size - count), 1))


def price_of_continuity(loosest: SegmentSolution, found: SegmentSolution) -> float:
    """Return the p-value of the rise in cost from free segments to one trajectory.

    By the F distribution, each end of a segment that is no longer free being one degree: a small
    value says that the segments followed their data by jumps that no noise explains.
    """
    assert found.space.continuity is not None
    ends = len(found.space.continuity.ends)
    measured = found.space.rows[-1].stop - ends
    left = measured - found.space.size
    rise = found.data_cost - loosest.data_cost
    if ends == 0 or left <= 0 or not (rise > 0.0 and loosest.data_cost > 0.0):
        return 1.0
    return float(fdtrc(ends, left, (rise / ends) / (loosest.data_cost / left)))


def _jumps(space: SearchSpace, solution: Solution) -> FloatArray:
    """Differences between segments, from the rows that count them."""
    continuity, at = space.continuity, solution.at
    assert continuity is not None
    if at is None or not at.ok:
        return np.full(len(continuity.ends), np.nan)
    return continuity.differences(
        [np.zeros(0) if each.residuals is None else each.residuals for each in at.outcomes]
    )


def response(blocks: BlockMatrix, size: int) -> FloatArray:
    """(unknowns of the segments, unknowns of the fit): how all move while the residuals are least.

    The first `size` of them are the unknowns of the fit. The states of the segments are eliminated
    one after the other, which stays accurate where the sensitivities of a whole simulation would
    grow beyond all bounds.
    """
    border = np.zeros(blocks.size, bool)
    border[:size] = True
    norms = blocks.norms()
    units = np.where(norms > 0.0, norms, 1.0)
    chains = make_chains(blocks.divided_columns(units), np.zeros(blocks.row_count), border)
    free, nothing = np.zeros(blocks.size, bool), np.zeros(blocks.size)
    found = np.zeros((blocks.size, size))
    found[np.arange(size), np.arange(size)] = 1.0
    for chain in chains:
        eliminated = eliminate(chain, free, nothing, nothing)
        for i in chain.border.tolist():
            column = np.zeros(blocks.size)
            eliminated.substitute(column, (chain.border == i) * units[i], 0.0)
            inner = np.flatnonzero(column)
            found[inner, i] = column[inner] / units[inner]
    return found
