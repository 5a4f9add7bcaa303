"""Cuts records into segments for multiple shooting.

Each segment is a separate experiment; its final states are additional residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from cluster_est.errors import ProblemError
from cluster_est.problem.compatibility import besides_plain_outputs
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import refuse_process_noise
from cluster_est.settings import Finite, Settings, sentence
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Input, IntArray, Output

LEAST_SAMPLES_OF_SEGMENT = 4
"""Least number of samples of a segment after halving."""


class Shooting(Settings):
    """The segments of each training record, given by their number or their length."""

    section: ClassVar[str] = "method.shooting"

    segments: int | None = Field(
        None,
        ge=2,
        description=(
            "number of segments of each training record; fewer if the record has fewer measured "
            "times"
        ),
    )
    length: Finite | None = Field(
        None,
        gt=0.0,
        description="longest duration of a segment in seconds; give it instead of segments",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.segments is None) == (self.length is None):
            given = "neither" if self.segments is None else "both"
            raise sentence(
                f"{self.section}: must have either segments or length, but has {given}; write {{ "
                "segments = 20 }, or { length = 0.5 } (in seconds)"
            )
        return self

    def halved(self, problem: Problem) -> Shooting | None:
        """Return the settings for segments of half the length; None if they had too few samples."""
        longest = max(
            (e.stop - e.start) / max((len(o.times) for o in e.outputs), default=1)
            for e in problem.experiments
            if e.role == "train"
        )
        shortest = min(
            (e.stop - e.start) / self.segments if self.segments else self.length or 0.0
            for e in problem.experiments
            if e.role == "train"
        )
        if 0.5 * shortest < LEAST_SAMPLES_OF_SEGMENT * longest:
            return None
        if self.segments:
            return Shooting(segments=2 * self.segments)
        return Shooting(length=0.5 * (self.length or 0.0))


@dataclass(frozen=True)
class SegmentStates:
    """The states of a model, and the parameters for their initial values.

    Attributes
    ----------
    names
        Names of the states in the order of the FMU.
    owner
        The state to which each name or alias belongs.
    parameters
        For each state, the parameter for its initial value: that of the problem if there is one, or
        an added parameter.
    added
        The added parameters.
    """

    names: tuple[str, ...]
    owner: Mapping[str, str]
    parameters: tuple[Parameter, ...]
    added: tuple[Parameter, ...]


def segment_states(problem: Problem, description: ModelDescription) -> SegmentStates:
    """Return the states of a model, if their initial values can be set.

    Raises
    ------
    ProblemError
        If the model has no states, or a state cannot be set.
    """
    names = description.states
    if not names:
        raise ProblemError(
            f"method.shooting: needs a model with states, but {description.file} has none, so each "
            "sample is independent already; leave method.shooting out"
        )
    owner = {
        alias: state for state in names for alias in (state, *description.variables[state].aliases)
    }
    taken = {p.name for p in problem.parameters}
    chosen, added = [], []
    for state in names:
        known = [p for p in problem.parameters if owner.get(p.target) == state]
        if known:
            _check_plain(known[0])
        else:
            added.append(_made(state, description, taken))
        chosen.append(known[0] if known else added[-1])
    return SegmentStates(names, owner, tuple(chosen), tuple(added))


def _check_plain(parameter: Parameter) -> None:
    if parameter.expression:
        raise ProblemError(
            "method.shooting: needs states that can be set independently, but "
            f"{parameter.target!r} follows from the expression of "
            f"{dotted('parameters', parameter.name)}; estimate this state, or give its value"
        )


def _made(state: str, description: ModelDescription, taken: set[str]) -> Parameter:
    variable = description.variables[state]
    if not variable.settable or variable.start is None:
        raise ProblemError(
            f"method.shooting: needs states whose start values can be set, but {description.file} "
            f"computes the start value of {state!r}; export it so that it can be set (in Modelica: "
            "start = ..., fixed = true), or leave method.shooting out"
        )
    name = state
    while name in taken:
        name += "_"
    taken.add(name)
    return Parameter(name, variable.start, variable=state, unit=variable.unit)


END_SIGMA = 1.0


@dataclass(frozen=True)
class Segment:
    """A segment of a record.

    Attributes
    ----------
    record
        Index of the record among the problem's experiments.
    number
        Number of the segment in the record, counted from 0.
    experiment
        The simulated experiment.
    places : (residuals,)
        Index of each residual among those of the record; -1 for residuals of final states.
    ends
        Index of each final state's residual; empty for the last segment of a record.
    sigmas
        Sigmas of these residuals.
    """

    record: int
    number: int
    experiment: Experiment
    places: IntArray = field(repr=False)
    ends: tuple[int, ...]
    sigmas: tuple[float, ...]

    @property
    def is_last(self) -> bool:
        return not self.ends


@dataclass(frozen=True)
class SegmentedProblem:
    """The training records of a problem in segments.

    Attributes
    ----------
    original
        The problem with whole records.
    problem
        The problem with segments as its experiments, and a parameter for each state.
    segments
        Segments in the order of the records.
    states
        States of the model.
    """

    original: Problem
    problem: Problem
    segments: tuple[Segment, ...]
    states: SegmentStates

    def of_record(self, record: int) -> list[int]:
        """Return the positions of a record's segments."""
        return [i for i, segment in enumerate(self.segments) if segment.record == record]


def cut(problem: Problem, shooting: Shooting) -> SegmentedProblem:
    """Cut the training records of a problem into segments.

    A segment begins at a measured time, whose values belong to it, and ends at the start of the
    next segment. The states at these times are estimated.

    Raises
    ------
    ProblemError
        If the model, an effect or an experiment does not allow segments.
    """
    description = problem.describe()
    states = segment_states(problem, description)
    _check_effects(problem, description)
    segments: list[Segment] = []
    for record in problem.indices("train"):
        segments += _cut_record(problem.experiments[record], record, shooting, states)
    count = len(problem.model.parameters)
    parameters = [p for p in problem.parameters if not p.auxiliary]
    auxiliary = [p for p in problem.parameters if p.auxiliary]
    model = replace(
        problem.model,
        parameters=(*problem.model.parameters, *(p.target for p in states.added)),
    )
    made = Problem(
        model=model,
        parameters=(*parameters[:count], *states.added, *parameters[count:], *auxiliary),
        experiments=tuple(segment.experiment for segment in segments),
        cost=SumSquared(),
        effects=problem.effects,
        constraints=problem.constraints,
        units=problem.units,
    )
    return SegmentedProblem(problem, made, tuple(segments), states)


def _check_effects(problem: Problem, description: ModelDescription) -> None:
    """Refuse effects with memory, because a segment has no history."""
    if not problem.effects:
        return
    refuse_process_noise(problem, "method.shooting")
    from workers.effects.definition import define_all  # needs SymPy, which is slow to import

    for defined in define_all(
        problem.effects, description, problem.model.interface, problem.experiments
    ):
        if defined.states or defined.form.memory:
            what = "has an internal state" if defined.states else "depends on the past"
            raise ProblemError(
                f"method.shooting: cannot be used with effect {defined.effect.name!r}, which "
                f"{what}, because a segment has no history; leave one of the two out"
            )


def _check_record(experiment: Experiment) -> None:
    where = f"method.shooting: cannot cut experiment {experiment.id!r}, because it has"
    for what in besides_plain_outputs(experiment):
        raise ProblemError(
            f"{where} {what}, which applies to the whole record; remove that, or leave "
            "method.shooting out"
        )


def _cut_record(
    experiment: Experiment, record: int, shooting: Shooting, states: SegmentStates
) -> list[Segment]:
    _check_record(experiment)
    edges = _edges(experiment, shooting)
    last = len(edges) - 2
    return [
        _segment(experiment, record, k, (edges[k], edges[k + 1]), states, last=k == last)
        for k in range(last + 1)
    ]


def _edges(experiment: Experiment, shooting: Shooting) -> list[float]:
    """Return the ends of segments: the measured times that are closest to equal parts."""
    start, stop = experiment.start, experiment.stop
    times = np.unique(np.concatenate([output.times for output in experiment.outputs]))
    inside = times[(times > start) & (times < stop)]
    if shooting.length is not None:
        count = max(int(np.ceil((stop - start) / shooting.length - 1e-9)), 1)
    else:
        count = shooting.segments or 1
    if not len(inside):
        return [start, stop]
    wanted = np.linspace(start, stop, min(count, len(inside) + 1) + 1)[1:-1]
    after = np.clip(np.searchsorted(inside, wanted), 1, len(inside) - 1) if len(inside) > 1 else 0
    before = np.maximum(after - 1, 0)
    nearer = np.where(
        np.abs(inside[before] - wanted) <= np.abs(inside[after] - wanted), before, after
    )
    return [start, *np.unique(inside[nearer]).tolist(), stop]


def _segment(
    experiment: Experiment,
    record: int,
    number: int,
    interval: tuple[float, float],
    states: SegmentStates,
    *,
    last: bool,
) -> Segment:
    start, stop = interval
    outputs, places, first = [], [], 0
    for output in experiment.outputs:
        inside = (output.times >= start) & ((output.times < stop) | last)
        chosen = np.flatnonzero(inside)  # an output without samples is also recorded
        outputs.append(output.only(chosen))
        places.append(first + chosen)
        first += len(output.times)
    if not last:
        _append_ends(outputs, places, stop, states)
    joined = np.concatenate([np.zeros(0, np.intp), *places])
    made = replace(
        experiment,
        id=f"{experiment.id} segment {number + 1}",
        start=start,
        stop=stop,
        inputs=tuple(_between(given, start, stop) for given in experiment.inputs),
        signals=tuple(_between(given, start, stop) for given in experiment.signals),
        outputs=tuple(outputs),
        values=tuple(
            (name, value)
            for name, value in experiment.values
            if number == 0 or name not in states.owner
        ),
        record=experiment.record_id,
    )
    ends = () if last else _end_rows(outputs, states)
    sigmas = () if last else tuple(_output(outputs, name).sigmas[-1] for name in states.names)
    return Segment(record, number, made, joined, ends, tuple(float(s) for s in sigmas))


def _append_ends(
    outputs: list[Output], places: list[IntArray], stop: float, states: SegmentStates
) -> None:
    """Add a sample of each state at the end of a segment, compared with 0."""
    known = [output.variable for output in outputs]
    for name in states.names:
        if name in known:
            i = known.index(name)
            times, values = np.append(outputs[i].times, stop), np.append(outputs[i].values, 0.0)
            outputs[i] = replace(outputs[i], times=times, values=values)
            places[i] = np.append(places[i], -1)
        else:
            outputs.append(Output(name, np.array([stop]), np.zeros(1), END_SIGMA))
            places.append(np.array([-1], np.intp))


def _output(outputs: Sequence[Output], name: str) -> Output:
    return next(output for output in outputs if output.variable == name)


def _end_rows(outputs: Sequence[Output], states: SegmentStates) -> tuple[int, ...]:
    """Return the index of each final state's residual: the last residual of its output."""
    ends = np.cumsum([len(output.times) for output in outputs]).tolist()
    last = {output.variable: end - 1 for output, end in zip(outputs, ends, strict=True)}
    return tuple(last[name] for name in states.names)


def _between(given: Input, start: float, stop: float) -> Input:
    """Return the samples of an input within a segment, and the ones before and after it."""
    first = max(int(np.searchsorted(given.times, start, "right")) - 1, 0)
    behind = int(np.searchsorted(given.times, stop, "left")) + 1
    return replace(given, times=given.times[first:behind], values=given.values[first:behind])


def measured_at(output: Output, time: float) -> float:
    """Return the measured value of an output at a time, with linear interpolation."""
    times: FloatArray = output.times
    return float(np.interp(time, times, output.values))
