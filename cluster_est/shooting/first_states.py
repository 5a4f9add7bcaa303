"""States for segments to begin with: as measured, else carried on from segment to segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.shooting.record_segments import SegmentedProblem, measured_at
from cluster_est.shooting.segment_space import segment_values
from workers.messages import FloatArray, Outcome, Trajectory

STATE_IN_OUTPUT_TOLERANCE = 1e-6
"""Residual of a state as a line in an output, over the state's spread, up to which it is one."""
LEAST_SAMPLES_FOR_STATE = 4
LEAST_SPREAD_OF_STARTS = 1e-3
"""Spread of segments' starts, over what is known of it, that says nothing."""
SAME_FIRST_STATE = 1e-6
"""Distance of a segment's first state from what was set, over its size, that is negligible."""


@dataclass(frozen=True)
class MeasuredState:
    """A state that an output measures: state = offset + slope * output."""

    state: int
    output: str
    offset: float
    slope: float


@dataclass(frozen=True)
class FirstStates:
    """States that a search of segments begins with.

    Attributes
    ----------
    starts : (segments, states)
        For each segment.
    spread : (states,)
        See `spread_of_states`.
    measured
        Which of them an output measures.
    """

    starts: FloatArray = field(repr=False)
    spread: FloatArray
    measured: tuple[MeasuredState, ...]


def first_states(runner: Runner, segmented: SegmentedProblem, train: SearchSpace) -> FirstStates:
    """Simulate each record segment by segment, and put each segment where the record is measured.

    A state that is an output, or a line in one, begins each segment with the measured value. The
    others go on as they ended; or they begin as the record did, in a segment that follows its data
    better from there: what grows without limit at a wrong start of the parameters says nothing.

    Raises
    ------
    ProblemError
        If the model does not begin where it was set.
    """
    columns = [segmented.problem.parameters.index(p) for p in segmented.states.parameters]
    values = _at_start(segmented, train)
    starts = values[:, columns].copy()
    carried = np.full(len(segmented.segments), np.inf)
    courses: list[FloatArray] = [np.zeros((0, len(columns)))] * len(segmented.segments)
    measured: tuple[MeasuredState, ...] = ()
    for number in range(max(segment.number for segment in segmented.segments) + 1):
        rows = [i for i, s in enumerate(segmented.segments) if s.number == number]
        outcomes = _simulate(runner, segmented, values, rows)
        if number == 0:
            measured = find_measured(segmented, rows, outcomes)
        for row, outcome in zip(rows, outcomes, strict=True):
            carried[row] = _cost(segmented, row, outcome)
            courses[row] = _states(segmented, outcome.trajectory)
            _check_begin(segmented, row, outcome.trajectory, starts[row])
            if not segmented.segments[row].is_last:
                reached = _states(segmented, outcome.trajectory)
                following = reached[-1] if len(reached) else starts[row]
                following = np.where(np.isfinite(following), following, starts[row])
                starts[row + 1] = _as_measured(segmented, row, following, measured)
                values[row + 1, columns] = starts[row + 1]
    again = _from_first(segmented, starts, measured)
    values[:, columns] = again
    everything = list(range(len(segmented.segments)))
    outcomes = _simulate(runner, segmented, values, everything)
    for row, outcome in zip(everything, outcomes, strict=True):
        if _cost(segmented, row, outcome) < carried[row]:
            starts[row] = again[row]
            courses[row] = _states(segmented, outcome.trajectory)
    known = _spread_of_courses(segmented, courses)
    return FirstStates(starts, spread_of_states(segmented, starts, measured, known), measured)


def _simulate(
    runner: Runner, segmented: SegmentedProblem, values: FloatArray, rows: list[int]
) -> list[Outcome]:
    effects = segmented.problem.effects
    return runner.simulate(values[rows], rows, "trajectory", "segments", effects)


def _cost(segmented: SegmentedProblem, row: int, outcome: Outcome) -> float:
    """The sum of squares of a segment's measured values; infinite where it failed."""
    if outcome.residuals is None:
        return np.inf
    measured = outcome.residuals[segmented.segments[row].places >= 0]
    with np.errstate(over="ignore"):
        return float(np.add.reduce(measured * measured))


def _as_measured(
    segmented: SegmentedProblem,
    row: int,
    states: FloatArray,
    measured: tuple[MeasuredState, ...],
) -> FloatArray:
    """States at the end of a segment, those that are measured there as they are measured."""
    segment = segmented.segments[row]
    record = segmented.original.experiments[segment.record]
    result = states.copy()
    for each in measured:
        output = next((o for o in record.outputs if o.variable == each.output), None)
        if output is not None and len(output.times):
            value = measured_at(output, segment.experiment.stop)
            result[each.state] = each.offset + each.slope * value
    return result


def _from_first(
    segmented: SegmentedProblem, starts: FloatArray, measured: tuple[MeasuredState, ...]
) -> FloatArray:
    """(segments, states): measured ones as they are, the others as at the record's start."""
    result = starts.copy()
    known = {each.state for each in measured}
    others = [i for i in range(starts.shape[1]) if i not in known]
    for row, segment in enumerate(segmented.segments):
        result[row, others] = starts[row - segment.number, others]
    return result


def _at_start(segmented: SegmentedProblem, train: SearchSpace) -> FloatArray:
    """(segments, parameters): the physical values of the fit's start."""
    values = segment_values(segmented, train)
    names = {p.name: i for i, p in enumerate(segmented.problem.parameters)}
    old = [names[p.name] for p in train.problem.parameters if not p.auxiliary]
    table = train.physical(train.start)
    position = {record: i for i, record in enumerate(train.experiments)}
    for row, segment in enumerate(segmented.segments):
        values[row, old] = table[position[segment.record]]
    inside = [i for i, p in enumerate(segmented.problem.parameters) if not p.auxiliary]
    return np.ascontiguousarray(values[:, inside])


def _states(segmented: SegmentedProblem, trajectory: Trajectory | None) -> FloatArray:
    """(times, states) along a segment; empty where it failed, or in a last one without them."""
    names = segmented.states.names
    if trajectory is None or any(name not in trajectory.variables for name in names):
        return np.zeros((0, len(names)))
    columns = [trajectory.variables.index(name) for name in names]
    return np.asarray(trajectory.values[:, columns])


def _check_begin(
    segmented: SegmentedProblem, row: int, path: Trajectory | None, wanted: FloatArray
) -> None:
    """Refuse a model that computes its initial states, whatever they were set to."""
    segment = segmented.segments[row]
    if path is None or segment.is_last or path.times[0] != segment.experiment.start:
        return
    begins = _states(segmented, path)
    for name, is_, set_ in zip(segmented.states.names, begins[0], wanted, strict=True):
        if abs(is_ - set_) > SAME_FIRST_STATE * max(abs(set_), abs(is_), 1e-12):
            raise ProblemError(
                f"method.shooting: needs a model that begins with the given states, but {name!r} "
                f"of {segmented.original.model.name} was set to {set_:.6g} in "
                f"{segment.experiment.id!r} and began at {is_:.6g}; export the model with fixed "
                "start values, or leave method.shooting out"
            )


def find_measured(
    segmented: SegmentedProblem, rows: list[int], outcomes: list[Outcome]
) -> tuple[MeasuredState, ...]:
    """Return for each state an output that it is, or a line in which it is, along simulations."""
    paths = [o.trajectory for o in outcomes if o.trajectory is not None]
    states = [_states(segmented, path) for path in paths]
    if not paths or not all(len(each) for each in states):
        return ()
    joined = np.concatenate(states)
    names = {o.variable for i in rows for o in segmented.segments[i].experiment.outputs}
    common = [n for n in sorted(names) if all(n in path.variables for path in paths)]
    compared = [name for name in common if name not in segmented.states.names]
    own = {name: i for i, name in enumerate(segmented.states.names)}
    recorded = {
        o.variable
        for r in {segmented.segments[i].record for i in rows}
        for o in segmented.original.experiments[r].outputs
    }
    found: dict[int, MeasuredState] = {
        own[name]: MeasuredState(own[name], name, 0.0, 1.0) for name in recorded if name in own
    }
    for name in compared:
        values = np.concatenate([p.values[:, p.variables.index(name)] for p in paths])
        for state in range(joined.shape[1]):
            line = line_between(values, joined[:, state])
            if state not in found and line is not None:
                found[state] = MeasuredState(state, name, *line)
    return tuple(found[state] for state in sorted(found))


def line_between(output: FloatArray, state: FloatArray) -> tuple[float, float] | None:
    """Offset and slope of a state as a line in an output; None if it is not a line."""
    if len(output) < LEAST_SAMPLES_FOR_STATE or not np.isfinite(output).all():
        return None
    spread = float(np.std(state))
    if not (np.isfinite(state).all() and spread > 0.0 and np.std(output) > 0.0):
        return None
    design = np.column_stack([np.ones(len(output)), output])
    (offset, slope), *_ = np.linalg.lstsq(design, state, rcond=None)
    left = float(np.std(state - offset - slope * output))
    return (float(offset), float(slope)) if left <= STATE_IN_OUTPUT_TOLERANCE * spread else None


def _spread_of_courses(segmented: SegmentedProblem, courses: Sequence[FloatArray]) -> FloatArray:
    """(states,): the standard deviation of each along all segments; its nominal where that is 0."""
    joined = np.concatenate(courses)
    known = segmented.problem.describe().variables
    nominal = np.array([known[name].nominal for name in segmented.states.names], np.float64)
    if len(joined) < LEAST_SAMPLES_FOR_STATE:
        return nominal
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.std(joined, axis=0)
    return np.asarray(np.where(np.isfinite(spread) & (spread > 0.0), spread, nominal))


def spread_of_states(
    segmented: SegmentedProblem,
    starts: FloatArray,
    measured: tuple[MeasuredState, ...],
    known: FloatArray,
) -> FloatArray:
    """(states,): the standard deviation of each as it is measured, else over segments' starts.

    Where those hardly differ, it is what was known of it before.
    """
    spread = np.std(starts, axis=0)
    for each in measured:
        values = [
            o.values
            for r in segmented.original.indices("train")
            for o in segmented.original.experiments[r].outputs
            if o.variable == each.output
        ]
        spread[each.state] = abs(each.slope) * float(np.std(np.concatenate(values)))
    return np.asarray(
        np.where(np.isfinite(spread) & (spread > LEAST_SPREAD_OF_STARTS * known), spread, known)
    )
