"""Searches with segments, with an increasing weight of the continuity.

With a small weight, each segment follows its data. There are few local minima, because errors of
parameters do not accumulate over the record. The weight is then increased until the segments form
one trajectory (the penalty method; J. Nocedal, S. J. Wright, Numerical Optimization (2006),
doi:10.1007/978-0-387-40065-5, chapter 17). Steps are computed by orthogonal factorisation, so large
weights do not reduce the accuracy.
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
    """Return the root mean square over outputs of the measured standard deviation over sigma."""
    ratios = [float(np.std(o.values)) / float(np.median(o.sigmas)) for o in _outputs(problem)]
    return float(np.sqrt(np.mean(np.square(ratios)))) or 1.0


def cost_of_constants(problem: Problem) -> float:
    """Return the sum of squares if a constant is fitted to each output of each training record."""
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
        Search space with the weight of the search; it starts at the solution.
    solution
        Solution of the search.
    jumps : (ends,)
        Differences between the start of a segment and the end of the previous segment, in the units
        of the states.
    spread : (states,)
        Standard deviation of each state.
    """

    space: SearchSpace
    solution: Solution
    jumps: FloatArray = field(repr=False)
    spread: FloatArray

    @classmethod
    def of(cls, space: SearchSpace, solution: Solution, spread: FloatArray) -> SegmentSolution:
        """Return the segment solution for the solution of a search."""
        return cls(space.starting_at(solution.x), solution, _jumps(space, solution), spread)

    @property
    def works(self) -> bool:
        """Whether the solution could be simulated."""
        return self.solution.at is not None and self.solution.at.ok

    @property
    def largest_jump(self) -> float:
        """The largest jump over the spread of the state; NaN if the simulation failed."""
        relative = np.abs(self.jumps) / np.resize(self.spread, len(self.jumps))
        return float(np.max(relative, initial=0.0))

    @property
    def data_cost(self) -> float:
        """The sum of squares without the differences between segments."""
        continuity = self.space.continuity
        assert continuity is not None
        counted = continuity.weight * self.jumps / continuity.scales
        return float(self.solution.cost - np.add.reduce(counted * counted))

    @property
    def variance(self) -> float:
        """The variance of the residuals; each continuity condition determines one unknown."""
        assert self.space.continuity is not None
        count = len(self.space.continuity.ends)
        measured = self.space.rows[-1].stop - count
        return float(self.data_cost / max(measured - (self.space.size - count), 1))


def price_of_continuity(loosest: SegmentSolution, found: SegmentSolution) -> float:
    """Return the p-value of the cost increase from free segments to one trajectory.

    It follows from the F distribution, with one degree of freedom for each final state. If it is
    small, the segments followed their data by jumps that noise does not explain.
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
    """Return the differences between segments, from their residuals."""
    continuity, at = space.continuity, solution.at
    assert continuity is not None
    if at is None or not at.ok:
        return np.full(len(continuity.ends), np.nan)
    return continuity.differences(
        [np.zeros(0) if each.residuals is None else each.residuals for each in at.outcomes]
    )


def response(blocks: BlockMatrix, size: int) -> FloatArray:
    """Return the change of all unknowns with the fit's unknowns, with minimal residuals.

    The result has the shape (unknowns of the segments, unknowns of the fit). The first `size`
    unknowns are those of the fit. The states of the segments are eliminated one after the other.
    This is accurate even if the sensitivities of a whole simulation would grow without limit.
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
"""Weights of a difference of one standard deviation of a state, relative to a residual of one
standard deviation of an output."""
JOINED = 1e-3
"""Largest difference between joined segments, over the spread of the state."""
LOOSE = 1e-3
"""Least `ftol` of all searches except the last one."""
CONTINUOUS = 1e-6
"""Largest difference between segments, over the spread of the state, that is negligible."""
UNNOTICED = 0.04
"""Change of the sum of squares, over the variance of the residuals, that is negligible."""


FOLLOWS = 0.05
"""Cost of segments with free states, over that of constants, above which the segments are too long
to follow the data."""
LEAST_REMAINING_DIFFERENCE = 0.3
"""Ratio of the largest difference to that at a tenth of the weight, above which the difference is
an error of the solver."""


@dataclass(frozen=True)
class SegmentSearch:
    """The end of the searches on segments.

    Attributes
    ----------
    found
        The last solution.
    loosest
        The first solution, with the smallest weight of continuity.
    too_long
        Whether shorter segments should be tried, because these do not follow their data even with
        free states, or do not join.
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
    """Search with increasing weights until the segments form one trajectory.

    Parameters
    ----------
    runner
        Runs the simulations of the segments.
    segmented, space
        The problem in segments, and its search space.
    first
        The start values of the states.
    method, seed
        Method and random seed, as for whole records.
    last
        Whether shorter segments are not possible.
    """
    searches = _Searches(runner, segmented, seed)
    unit, spread = signal_to_noise(segmented.original), first.spread
    loose = replace(method, ftol=max(method.ftol, LOOSE), differences="forward")
    # forward sensitivities are not available for the final states of segments
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
                found = before  # the remaining differences do not decrease with the weight
                break
            change = abs(found.data_cost - before.data_cost)
            if found.largest_jump <= CONTINUOUS or change <= UNNOTICED * found.variance:
                break  # the segments form one trajectory, or a larger weight has no effect
        before, space, spread = found, found.space, _spread(segmented, found, first)
        if found.solution.ending is Ending.STALLED:  # the differences contain only solver noise
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
        """Return the space that starts with states fitted to the data, with constant parameters.

        Unmeasured states start with simulated values. Without this fit, the parameters would change
        to compensate the errors of these values.
        """
        alone = states_alone(self.segmented, space)
        solution = self._solution(alone, method, "segments, states alone")
        return with_states(self.segmented, space, solution.x)

    def _solution(self, space: SearchSpace, method: LeastSquares, name: str) -> Solution:
        self.runner.display.phase = name
        (solution,) = self.runner.run([SearchRequest(name, method, space, self.seed)])
        return solution


def _spread(segmented: SegmentedProblem, found: SegmentSolution, first: FirstStates) -> FloatArray:
    """Return the spread of the states at a solution."""
    columns = [segmented.problem.parameters.index(p) for p in segmented.states.parameters]
    starts = np.asarray(found.space.physical(found.solution.x)[:, columns])
    return spread_of_states(segmented, starts, first.measured, found.spread)
