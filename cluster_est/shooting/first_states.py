"""Start values for the initial states of segments, from measurements or from simulations."""

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
"""Largest residual of a state that is a linear function of an output, over the state's spread."""
LEAST_SAMPLES_FOR_STATE = 4
LEAST_SPREAD_OF_STARTS = 1e-3
"""Least spread of segments' starts, over the known spread of the state, that is used."""
SAME_FIRST_STATE = 1e-6
"""Negligible relative difference of a segment's first state from the given value."""


@dataclass(frozen=True)
class MeasuredState:
    """A state that is measured by an output: state = offset + slope * output."""

    state: int
    output: str
    offset: float
    slope: float


@dataclass(frozen=True)
class FirstStates:
    """Start values of the states in a search with segments.

    Attributes
    ----------
    starts : (segments, states)
        States at the start of each segment.
    spread : (states,)
        See `spread_of_states`.
    measured
        The states that are measured by an output.
    """

    starts: FloatArray = field(repr=False)
    spread: FloatArray
    measured: tuple[MeasuredState, ...]


def first_states(runner: Runner, segmented: SegmentedProblem, train: SearchSpace) -> FirstStates:
    """Simulate each record segment by segment, with measured states where they are available.

    A state that is an output, or a linear function of one, starts each segment with the measured
    value. Other states continue from the end of the previous segment. If a segment follows its data
    better with the record's initial values of these states, those are used instead. With wrong
    parameters, continued states may grow without limit.

    Raises
    ------
    ProblemError
        If the model does not start with the given states.
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
    """Return the sum of squares of a segment's residuals; infinite if its simulation failed."""
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
    """Return the states at the end of a segment, with measured values if available."""
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
    """Return starts whose unmeasured states are those at the record's start: (segments, states)."""
    result = starts.copy()
    known = {each.state for each in measured}
    others = [i for i in range(starts.shape[1]) if i not in known]
    for row, segment in enumerate(segmented.segments):
        result[row, others] = starts[row - segment.number, others]
    return result


def _at_start(segmented: SegmentedProblem, train: SearchSpace) -> FloatArray:
    """Return the physical start values of the fit: (segments, parameters)."""
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
    """Return the states along a segment: (times, states); empty if they are not known."""
    names = segmented.states.names
    if trajectory is None or any(name not in trajectory.variables for name in names):
        return np.zeros((0, len(names)))
    columns = [trajectory.variables.index(name) for name in names]
    return np.asarray(trajectory.values[:, columns])


def _check_begin(
    segmented: SegmentedProblem, row: int, path: Trajectory | None, wanted: FloatArray
) -> None:
    """Refuse a model that computes its initial states and ignores the given values."""
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
    """Return the states that equal an output, or a linear function of one, in simulations."""
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
    """Return offset and slope of a state as a linear function of an output; None if not linear."""
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
    """Return each state's standard deviation along all segments; its nominal value instead of 0."""
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
    """Return the standard deviation of each state: (states,).

    It is that of the measured output, or that over the starts of segments. If the starts hardly
    differ, the known value is returned.
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
