"""Multiple shooting: cut records into segments, find start values, search, and join segments."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Ending, GivenPoints, Method, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.output_errors import Simulation
from cluster_est.results.segments import SURPRISING, SegmentState, ShootingSummary
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.multistart import Multistart, MultistartResult, search_from_starts
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest, assemble_evaluation, with_priors
from cluster_est.running.sizes import with_sizes
from cluster_est.shooting.first_states import FirstStates, first_states
from cluster_est.shooting.record_segments import SegmentedProblem, Shooting, cut
from cluster_est.shooting.segment_search import (
    JOINED,
    SegmentSearch,
    SegmentSolution,
    cost_of_constants,
    price_of_continuity,
    response,
    search_segments,
)
from cluster_est.shooting.segment_space import make_segment_space
from cluster_est.uncertainty import intervals
from cluster_est.uncertainty.covariance.normal_equations import jacobian_blocks
from cluster_est.uncertainty.spaces import with_start
from workers.messages import FloatArray, Outcome, Trajectory


def joined_simulations(
    runner: Runner, segmented: SegmentedProblem, found: SegmentSolution
) -> list[Simulation]:
    """Simulate the segments again, and join those of each record.

    If the simulation of a segment fails, that of its record also counts as failed.
    """
    everything = tuple(range(len(segmented.segments)))
    values = found.space.physical(found.solution.x)
    outcomes = runner.simulate(
        values, everything, "trajectory", "segments", segmented.problem.effects
    )
    records = segmented.original.indices("train")
    return [Simulation(r, _joined(segmented, r, outcomes)) for r in records]


def _joined(segmented: SegmentedProblem, record: int, outcomes: list[Outcome]) -> Outcome:
    rows = segmented.of_record(record)
    failed = [outcomes[row] for row in rows if not outcomes[row].ok]
    if failed:
        return replace(failed[0], trajectory=None, residuals=None)
    experiment = segmented.original.experiments[record]
    residuals = np.zeros(experiment.size)
    times, values = [], []
    names = experiment.recorded
    for row in rows:
        segment, outcome = segmented.segments[row], outcomes[row]
        path = outcome.trajectory
        assert path is not None
        assert outcome.residuals is not None
        own = segment.places >= 0
        residuals[segment.places[own]] = outcome.residuals[own]
        kept = slice(None) if segment.is_last else path.times < segment.experiment.stop
        times.append(path.times[kept])
        columns = [path.variables.index(name) for name in names]
        values.append(path.values[:, columns][kept])
    first = outcomes[rows[0]]
    return replace(
        first,
        residuals=residuals,
        trajectory=Trajectory(names, np.concatenate(times), np.concatenate(values)),
        steps=sum(outcomes[row].steps for row in rows),
        seconds=sum(outcomes[row].seconds for row in rows),
    )


def joined_solution(
    segmented: SegmentedProblem,
    train: SearchSpace,
    found: SegmentSolution,
    simulations: list[Simulation],
) -> Solution:
    """Return the solution with segments as a solution of the fit.

    Its Jacobian contains the derivatives by the fit's unknowns, with the states of all segments
    adapted to them. The states are eliminated from the Jacobian of the segments. This is accurate
    even if the sensitivities of a whole simulation would grow without limit.
    """
    solution = found.solution
    x = solution.x[: train.size]
    outcomes = tuple(
        with_priors(train, x, e, replace(each.outcome, trajectory=None))
        for e, each in enumerate(simulations)
    )
    at = assemble_evaluation(train, x, outcomes, -1)
    steps, frozen = solution.difference_steps, solution.frozen
    blocks = jacobian_blocks(found.space, solution)
    return replace(
        solution,
        x=x,
        cost=at.cost,
        at=at,
        jacobian=None if blocks is None else _reduced(segmented, train, blocks),
        block_jacobian=None,
        difference_steps=None if steps is None else steps[: train.size],
        frozen=None if frozen is None else frozen[: train.size],
    )


def _reduced(segmented: SegmentedProblem, train: SearchSpace, blocks: BlockMatrix) -> FloatArray:
    """Return the Jacobian of the fit: (residuals of the fit, unknowns of the fit)."""
    moved = response(blocks, train.size)
    result = np.zeros((train.rows[-1].stop, train.size))
    position = {record: i for i, record in enumerate(train.experiments)}
    for row, segment in enumerate(segmented.segments):
        own = blocks.blocks[row] @ moved[blocks.columns[row]]
        rows = train.rows[position[segment.record]]
        measured = segment.places >= 0
        result[rows.start + segment.places[measured]] = own[: len(segment.places)][measured]
        priors = own[len(segment.places) :]
        result[rows.stop - len(priors) : rows.stop] += priors if len(priors) else 0.0
    return result


LOWER = 0.99
"""Ratio of costs of shorter and longer segments above which shorter segments do not help."""


@dataclass(frozen=True)
class ShotFit:
    """The result of multiple shooting.

    Attributes
    ----------
    solution
        Solution of the fit with segments; None if it failed.
    simulations
        Simulation of each training record, joined from its segments.
    summary
        Summary for the result of the fit.
    interrupted
        Whether the search was interrupted.
    evaluations, simulated, failures
        Numbers of evaluated points, simulations and failed simulations.
    too_long
        Whether the segments did not follow their data, so that shorter ones may help.
    """

    solution: Solution | None
    simulations: tuple[Simulation, ...] = field(repr=False)
    summary: ShootingSummary
    interrupted: bool
    evaluations: int
    simulated: int
    failures: int
    too_long: bool = False


def check_shooting(train: SearchSpace, method: Method, shooting: Shooting) -> SegmentedProblem:
    """Refuse a fit for which segments are not possible; return the segments.

    Raises
    ------
    ProblemError
        If the method, the cost, the model or an experiment does not allow segments.
    """
    if not isinstance(method, LeastSquares):
        raise ProblemError(
            f'method.shooting: needs method.name = "least_squares", but it is {method.name}; '
            "change it, or leave method.shooting out"
        )
    cost = train.problem.cost
    if cost.name != "sse":
        raise ProblemError(
            'method.shooting: needs cost.name = "sse" (the weight of continuity is relative to '
            f"this cost), but cost.name is {cost.name!r}; change it, or leave method.shooting out"
        )
    return cut(train.problem, shooting)


def shoot(
    environment: RunEnvironment,
    train: SearchSpace,
    method: LeastSquares,
    shooting: Shooting,
    seed: int,
) -> ShotFit:
    """Fit the training records in segments; use shorter ones if these do not follow their data.

    Parameters
    ----------
    environment
        Workers, budget and listeners.
    train
        Search space of the fit.
    method, shooting, seed
        Method, segments and random seed.

    Raises
    ------
    ClusterEstError
        If the model does not allow segments, or no workers can be started.
    """
    segmented = check_shooting(train, method, shooting)
    asked, begin = len(segmented.segments), time.monotonic()
    taken: list[ShotFit] = []
    best: ShotFit | None = None
    while True:
        used = sum(each.evaluations for each in taken)
        shorter = shooting.halved(train.problem)
        shot = _shoot(
            environment.left(used, time.monotonic() - begin),
            train,
            segmented,
            (method, seed),
            last=shorter is None,
        )
        taken.append(shot)
        if best is not None and shot.summary.cost > LOWER * best.summary.cost:
            shot = best  # shorter segments give the same result, so the length is not the cause
            break
        best = None if shot.too_long else shot
        followed = not shot.too_long and shot.summary.continuity_p > SURPRISING
        if shorter is None or followed or shot.interrupted or shot.summary.stopped:
            break
        shooting, segmented = shorter, cut(train.problem, shorter)
    return replace(
        shot,
        summary=replace(shot.summary, asked=asked),
        evaluations=sum(each.evaluations for each in taken),
        simulated=sum(each.simulated for each in taken),
        failures=sum(each.failures for each in taken),
    )


def _shoot(
    environment: RunEnvironment,
    train: SearchSpace,
    segmented: SegmentedProblem,
    how: tuple[LeastSquares, int],
    *,
    last: bool,
) -> ShotFit:
    """Fit with these segments; `how` are the method and the random seed."""
    problem = segmented.problem
    with environment.executor(problem) as executor:
        runner = environment.runner(executor, record=environment.record_of(problem))
        runner.display.phase = "states at the starts of segments"
        first = first_states(runner, segmented, train)
        space = make_segment_space(segmented, train, first.starts, first.spread)
        space = with_sizes(runner, space)
        search = search_segments(runner, segmented, space, first, *how, last=last)
        found = search.found
        goes_on = found.works and not search.too_long
        simulations = joined_simulations(runner, segmented, found) if goes_on else []
        works = goes_on and all(each.outcome.ok for each in simulations)
        solution = joined_solution(segmented, train, found, simulations) if works else None
        return ShotFit(
            None if solution is None else _honest(solution, found),
            tuple(simulations),
            _summary(segmented, first, search, works),
            runner.interrupted,
            runner.evaluations,
            runner.simulations,
            runner.failures,
            search.too_long,
        )


def _honest(solution: Solution, found: SegmentSolution) -> Solution:
    """Mark a solution as not converged if its segments do not join."""
    if found.largest_jump <= JOINED or not solution.ending.success:
        return solution
    message = (
        "the segments do not join: the largest jump between two segments is "
        f"{found.largest_jump:.2g} times the spread of the state; begin closer to the solution, or "
        "use shorter segments"
    )
    return replace(solution, ending=Ending.STALLED, message=message)


def _summary(
    segmented: SegmentedProblem, first: FirstStates, search: SegmentSearch, works: bool
) -> ShootingSummary:
    found, solution = search.found, search.found.solution
    loosest = search.loosest
    return ShootingSummary(
        segments=len(segmented.segments),
        joined=False,
        largest_jump=found.largest_jump,
        cost=found.data_cost,
        whole_cost=np.nan,
        stopped=solution.ending in (Ending.BUDGET, Ending.INTERRUPTED),
        free_cost=np.nan if loosest is None else loosest.data_cost,
        continuity_p=1.0 if loosest is None else price_of_continuity(loosest, found),
        reason="" if works else solution.message or str(solution.ending),
        states=_states(segmented, first, found) if works else (),
    )


def _states(
    segmented: SegmentedProblem, first: FirstStates, found: SegmentSolution
) -> tuple[SegmentState, ...]:
    units = {p.target: p.unit for p in segmented.states.parameters}
    known = found.space.continuity
    assert known is not None
    values, count = found.solution.x, len(segmented.states.names)
    rows = []
    for i, (end, jump) in enumerate(zip(known.ends, found.jumps.tolist(), strict=True)):
        position = end.experiment + 1
        segment, state = segmented.segments[position], i % count
        rows.append(
            SegmentState(
                experiment=segmented.original.experiments[segment.record].id,
                segment=segment.number + 1,
                time=segment.experiment.start,
                state=segmented.states.names[state],
                unit=units.get(segmented.states.names[state], ""),
                guess=float(first.starts[position, state]),
                value=float(values[end.unknown]),
                jump=jump,
                relative_jump=jump / float(found.spread[state]),
            )
        )
    return tuple(rows)


WORTH_TRYING = 0.5
"""Largest cost of whole records, over that of constants, for a search with whole records."""
AS_GOOD = 1e-3
"""Largest relative excess of the cost of whole records over that of the segments."""
PROMISED = 0.3
"""Ratio of standard errors from whole records to those from segments below which the first are
unreliable. Negligible differences of states between segments would then change them."""
EXACT_FIT_COST = 1e-9
"""Additional excess of the cost of whole records, over the cost of constants, for segments with
residuals of 0."""


@dataclass(frozen=True)
class SearchResult:
    """The result of the search of a fit, with whole records or with segments.

    Attributes
    ----------
    minima
        Result of the final search.
    segmented
        Simulations of the training records in segments, if the result holds only for segments.
    shooting
        Summary of multiple shooting; None for a search with only whole records.
    """

    minima: MultistartResult
    segmented: tuple[Simulation, ...] = ()
    shooting: ShootingSummary | None = None

    def without(self, asked: tuple[str, ...]) -> SearchResult:
        """Return the result with a list of requested results that segments do not allow."""
        if not self.segmented or self.shooting is None:
            return self
        return replace(self, shooting=replace(self.shooting, left_out=asked))


def fit_whole_records(
    runner: Runner, train: SearchSpace, method: Method, shot: ShotFit, seed: int
) -> SearchResult:
    """Finish a fit with whole records, if they follow the data from the solution with segments.

    Otherwise, the solution with segments is kept. It is also kept if whole records give much
    smaller standard errors than segments. The cost of one trajectory of a chaotic model has very
    many equally good minima, and each is far narrower than their distance (L. M. Berliner, Stat.
    Sci. 7 (1992) 69-122, doi:10.1214/ss/1177011444). If the segments failed, this is an ordinary
    fit.
    """
    summary = shot.summary
    if shot.solution is None:
        found = search_from_starts(runner, train, method, Multistart(), seed)
        return SearchResult(found, shooting=summary)
    x = shot.solution.x
    runner.display.phase = "whole records"
    (at,) = runner.run([SearchRequest("whole records", GivenPoints(x[None, :], "whole"), train)])
    cost = at.evaluations[0].cost if at.evaluations else np.nan
    summary = replace(summary, whole_cost=float(cost))
    constants = cost_of_constants(train.problem)
    if runner.interrupted or cost < WORTH_TRYING * constants:
        begun = with_start(train, x)
        found = search_from_starts(runner, begun, method, Multistart(), seed)
        least = max(constants, float(len(train.outputs)))
        enough = shot.solution.cost * (1.0 + AS_GOOD) + EXACT_FIT_COST * least
        summary = replace(summary, promised=_promised(train, found.best, shot.solution))
        follows = found.best.cost <= enough and summary.promised > PROMISED
        if runner.interrupted or follows:
            return SearchResult(found, shooting=replace(summary, joined=True))
    kept = MultistartResult(train.start[None, :], (shot.solution,), (0,), (0,))
    return SearchResult(kept, shot.simulations, summary)


def _promised(train: SearchSpace, whole: Solution, segments: Solution) -> float:
    """Return the least ratio of a standard error from whole records to that from segments."""
    known = [
        np.array([interval.std_error for interval in intervals(train, solution)])
        for solution in (whole, segments)
    ]
    there = (known[0] > 0.0) & (known[1] > 0.0)
    return float(np.min(known[0][there] / known[1][there], initial=1.0))
