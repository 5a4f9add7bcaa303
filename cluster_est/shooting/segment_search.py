"""Searches on segments whose continuity counts more from one to the next.

While it counts little, each segment follows its data and the parameters are those that suit all of
them; there are few local minima, because no error of a parameter adds up over the record. Then the
states are drawn together until the segments are one trajectory (the penalty method; J. Nocedal,
S. J. Wright, Numerical Optimization (2006), doi:10.1007/978-0-387-40065-5, chapter 17). Orthogonal
factorisation solves for the steps, so large weights cost no accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import fdtrc

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.least_squares.sparse_step import eliminate, make_chains
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.shooting.first_states import FirstStates, spread_of_states
from cluster_est.shooting.record_segments import SegmentedProblem
from cluster_est.shooting.segment_space import states_alone, weighted, with_states
from workers.messages import FloatArray, Output


def signal_to_noise(problem: Problem) -> float:
    """The root mean square, over outputs, of the spread of what was measured over its sigma."""
    ratios = [float(np.std(o.values)) / float(np.median(o.sigmas)) for o in _outputs(problem)]
    return float(np.sqrt(np.mean(np.square(ratios)))) or 1.0


def cost_of_constants(problem: Problem) -> float:
    """The sum of squares of constants in the place of all outputs of the training records."""
    parts = [np.sum(((o.values - np.mean(o.values)) / o.sigmas) ** 2) for o in _outputs(problem)]
    return float(sum(parts))


def _outputs(problem: Problem) -> list[Output]:
    found = [o for e in problem.experiments if e.role == "train" for o in e.outputs]
    return [o for o in found if len(o.times)]


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


CONTINUITY_WEIGHTS = tuple(10.0**k for k in range(-1, 7))
"""Weights of a difference as large as the spread of a state, over that of a sample as large as the
spread of an output."""
JOINED = 1e-3
"""Largest difference between segments, over the spread of the state, of segments that join."""
LOOSE = 1e-3
"""`ftol` of all searches but the last ones."""
CONTINUOUS = 1e-6
"""Largest difference between segments, over the spread of the state, that is negligible."""
UNNOTICED = 0.04
"""Change of the sum of squares, over the variance of the residuals, that is negligible."""


FOLLOWS = 0.05
"""Cost of segments whose states are free, over that of constants, above which they are too long to
follow what was measured."""
LEAST_REMAINING_DIFFERENCE = 0.3
"""Part of the largest difference between segments that is left at a weight ten times as large,
above which the rest is the error of the solver."""


@dataclass(frozen=True)
class SegmentSearch:
    """The end of the searches on segments.

    Attributes
    ----------
    found
        The last solution.
    loosest
        The first one, while a difference between segments counted least.
    too_long
        Whether shorter segments are to be tried: these do not follow their data even from the best
        states, or do not join.
    """

    found: SegmentSolution
    loosest: SegmentSolution | None = None
    too_long: bool = False


def search_segments(
    runner: Runner,
    segmented: SegmentedProblem,
    space: SearchSpace,
    first: FirstStates,
    method: LeastSquares,
    seed: int,
    *,
    last: bool,
) -> SegmentSearch:
    """Search with one weight after the other, until the segments are one trajectory.

    Parameters
    ----------
    runner
        Its executor has the segments.
    segmented, space
        The problem, and its space.
    first
        What the space begins with.
    method, seed
        As for whole records.
    last
        Whether there are no shorter segments.
    """
    searches = _Searches(runner, segmented, seed)
    unit, spread = signal_to_noise(segmented.original), first.spread
    loose = replace(method, ftol=max(method.ftol, LOOSE), differences="forward")
    # forward sensitivities know nothing of the ends of segments
    sensitive = method.differences == "sensitivities"
    strict = replace(method, differences="auto") if sensitive else method
    space = searches.fitted_states(weighted(space, unit * CONTINUITY_WEIGHTS[0], spread), loose)
    before: SegmentSolution | None = None
    loosest: SegmentSolution | None = None
    for weight in CONTINUITY_WEIGHTS:
        space = weighted(space, unit * weight, spread)
        found = searches.run(space, spread, loose, f"segments, continuity counts {weight:g}")
        loosest = loosest or found
        if runner.interrupted or not found.works:
            return SegmentSearch(found)
        if before is None and not last:
            most = FOLLOWS * cost_of_constants(segmented.original)
            if found.data_cost > most:
                return SegmentSearch(found, too_long=True)
        if before is not None:
            small = before.largest_jump <= JOINED
            if small and found.largest_jump > LEAST_REMAINING_DIFFERENCE * before.largest_jump:
                found = before  # what is left of the differences does not shrink with the weight
                break
            change = abs(found.data_cost - before.data_cost)
            if found.largest_jump <= CONTINUOUS or change <= UNNOTICED * found.variance:
                break  # they are one trajectory, or a larger weight changes nothing any more
        before, space, spread = found, found.space, _spread(segmented, found, first)
        if found.solution.ending is Ending.STALLED:  # short differences see noise alone
            loose = replace(loose, differences="auto")
    last_one = searches.run(found.space, found.spread, strict, "segments, at the end")
    return SegmentSearch(last_one, loosest, not last and last_one.largest_jump > JOINED)


@dataclass(frozen=True)
class _Searches:
    """Runs searches of one problem in segments."""

    runner: Runner
    segmented: SegmentedProblem
    seed: int

    def run(
        self, space: SearchSpace, spread: FloatArray, method: LeastSquares, name: str
    ) -> SegmentSolution:
        """Search a space of segments."""
        return SegmentSolution.of(space, self._solution(space, method, name), spread)

    def fitted_states(self, space: SearchSpace, method: LeastSquares) -> SearchSpace:
        """Return the space from states that suit the data while the parameters stay.

        What is not measured has nothing better to begin with than a simulation; without this, the
        parameters would move to make up for it.
        """
        alone = states_alone(self.segmented, space)
        solution = self._solution(alone, method, "segments, states alone")
        return with_states(self.segmented, space, solution.x)

    def _solution(self, space: SearchSpace, method: LeastSquares, name: str) -> Solution:
        self.runner.display.phase = name
        (solution,) = self.runner.run([SearchRequest(name, method, space, self.seed)])
        return solution


def _spread(segmented: SegmentedProblem, found: SegmentSolution, first: FirstStates) -> FloatArray:
    """The spread of the states, where those that are not measured are found now."""
    columns = [segmented.problem.parameters.index(p) for p in segmented.states.parameters]
    starts = np.asarray(found.space.physical(found.solution.x)[:, columns])
    return spread_of_states(segmented, starts, first.measured, found.spread)
