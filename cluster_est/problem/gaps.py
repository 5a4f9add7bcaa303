"""Splits records at gaps: the part after a gap becomes a separate experiment.

This is done if a model cannot be simulated through a gap. The part after the gap has the record's
parameters and its own initial states, which are also estimated. If a state cannot be set, the part
after the gap is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.tables.gaps import InputGap, RecordGap, Treatment, input_gaps
from cluster_est.problem.unknowns import part_name
from workers.fmu.description import ModelDescription, describe_model
from workers.messages import Experiment, Input, Output, OwnStart

SOON = 3
"""Number of samples after the start of a part; an output whose first sample comes later does not
give the initial state."""


def split_at_gaps(problem: Problem) -> Problem:
    """Return a problem whose records are split at gaps according to each experiment's `gaps`.

    `Problem.gaps` lists the gaps. Without gaps, the same problem is returned.

    Raises
    ------
    ModelError
        If the FMU's description cannot be read.
    """
    if not any(given.times.size for e in problem.experiments for given in (*e.inputs, *e.signals)):
        return problem
    description = describe_model(problem.model)
    found = {e.id: input_gaps(e, description.holds) for e in problem.experiments}
    if not any(found.values()):
        return problem
    states = RestartableStates.of(problem, description)
    experiments: list[Experiment] = []
    gaps: list[RecordGap] = []
    for each in problem.experiments:
        parts, said = _parts(each, found[each.id], states)
        experiments += parts
        gaps += said
    if any(each.own_starts for each in experiments):
        problem = with_parameters(problem, states.added)
    return replace(problem, experiments=tuple(experiments), gaps=_each_once([*gaps, *problem.gaps]))


def _each_once(gaps: Sequence[RecordGap]) -> tuple[RecordGap, ...]:
    """Return the gaps without those that overlap an earlier gap in the same record."""
    kept: list[RecordGap] = []
    for gap in gaps:
        known = [k for k in kept if k.record == gap.record]
        if not any(k.first < gap.last and gap.first < k.last for k in known):
            kept.append(gap)
    return tuple(kept)


@dataclass(frozen=True)
class RestartableStates:
    """The states of a model, whose initial values a part of a record may set.

    Attributes
    ----------
    targets
        For each state, the name by which it is set.
    owner
        The state to which each name or alias belongs.
    limits
        For each target, the limits in the FMU.
    starts
        For each target, the default start value of an estimation.
    added
        New parameters for states that have no parameter in the problem.
    refusal
        Why a part cannot have its own initial states; "" if it can.
    """

    targets: Mapping[str, str] = field(default_factory=dict)
    owner: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    added: tuple[Parameter, ...] = ()
    refusal: str = ""

    @classmethod
    def of(cls, problem: Problem, description: ModelDescription) -> RestartableStates:
        """Return the restartable states of a problem's model."""
        if not description.states and problem.model.interface == "co_simulation":
            return cls(refusal=f"{description.file} names no states")
        owner = {
            name: state
            for state in description.states
            for name in (state, *description.variables[state].aliases)
        }
        given = {name for e in problem.experiments for name, _ in e.values}
        targets, starts, limits, added = {}, {}, {}, []
        taken = {p.name for p in problem.parameters}
        for state in description.states:
            variable = description.variables[state]
            own = [p for p in problem.parameters if owner.get(p.target) == state]
            names = sorted({p.target for p in own} | {n for n in given if owner.get(n) == state})
            if not variable.settable or variable.start is None:
                return cls(refusal=f"{description.file} computes the start of {state!r}")
            if len(names) > 1 or any(p.expression for p in own):
                return cls(refusal=f"{state!r} is set by more than one name or by an expression")
            target = names[0] if names else state
            targets[state] = target
            starts[target] = own[0].start if own else variable.start
            limits[target] = (
                -np.inf if variable.low is None else variable.low,
                np.inf if variable.high is None else variable.high,
            )
            if not own:
                added.append(_made(target, variable.start, variable.unit, taken))
        return cls(targets, owner, limits, starts, tuple(added))

    def own_starts(self, part: Experiment) -> tuple[OwnStart, ...]:
        """Return the initial states to estimate for a part.

        A state that is also an output starts at its first measured value. Limits of the FMU that
        exclude the start value are ignored.
        """
        known = dict(part.values)
        found = []
        for state, target in self.targets.items():
            names = [name for name, own in self.owner.items() if own == state]
            given = [float(known[name]) for name in names if name in known]
            start = given[0] if given else self.starts[target]
            for output in part.outputs:
                if output.variable in names and begins_at(output, part.start):
                    start = float(output.values[0])
            low, high = self.limits[target]
            wide = low < start < high
            found.append(OwnStart(target, start, *((low, high) if wide else (-np.inf, np.inf))))
        return tuple(found)


def begins_at(output: Output, start: float) -> bool:
    """Return whether an output is measured directly and near the start of a part."""
    if len(output.times) < 2 or not output.is_plain:
        return False
    return bool(output.times[0] - start <= SOON * np.median(np.diff(output.times)))


def _made(target: str, start: float, unit: str, taken: set[str]) -> Parameter:
    name = target
    while name in taken:
        name += "_"
    taken.add(name)
    return Parameter(name, start, variable=target, per="gap", unit=unit)


def with_parameters(problem: Problem, added: Sequence[Parameter]) -> Problem:
    """Return the problem with further parameters of the model after the existing ones."""
    count = len(problem.model.parameters)
    inside = [i for i, p in enumerate(problem.parameters) if not p.auxiliary]
    at = inside[count - 1] + 1 if count else 0
    targets = tuple(p.target for p in added)
    return replace(
        problem,
        model=replace(problem.model, parameters=(*problem.model.parameters, *targets)),
        parameters=(*problem.parameters[:at], *added, *problem.parameters[at:]),
    )


def _parts(
    experiment: Experiment, gaps: Sequence[InputGap], states: RestartableStates
) -> tuple[list[Experiment], list[RecordGap]]:
    """Return the parts of an experiment, and the treatment of each of its gaps."""
    moving = [gap for gap in gaps if gap.moving]
    said = [_said(experiment, gap, "run through") for gap in gaps if not gap.moving]
    if not moving:
        return [experiment], said
    why = _needs_whole(experiment)
    if experiment.gaps == "bridge" or why:
        return [experiment], said + [_said(experiment, gap, "bridged", why) for gap in moving]
    edges = [(experiment.start, moving[0].first)]
    if not states.refusal:
        ends = [*(gap.first for gap in moving[1:]), experiment.stop]
        edges += list(zip([gap.last for gap in moving], ends, strict=True))
    parts = [part_of(experiment, *edge, states) for edge in edges]
    kept = [part for part in parts if part is not None]
    if not kept:
        few = "nothing was measured outside the gap"
        return [experiment], said + [_said(experiment, gap, "bridged", few) for gap in moving]
    for k, gap in enumerate(moving):
        if states.refusal:
            said.append(_said(experiment, gap, "left out", states.refusal))
        elif parts[k + 1] is None:
            few = "too few values were measured after the gap"
            said.append(_said(experiment, gap, "left out", few))
        else:
            said.append(_said(experiment, gap, "split"))
    return kept, said


def _needs_whole(experiment: Experiment) -> str:
    """Return what refers to the whole record and so prevents a split; "" for nothing."""
    there = {
        "a curve": experiment.curve is not None,
        "a cost function": experiment.cost_function is not None,
        "bounds on signals": bool(experiment.bounds),
        "constraint functions": bool(experiment.constraint_functions),
    }
    return next((f"it has {what}" for what, has in there.items() if has), "")


def part_of(
    experiment: Experiment, start: float, stop: float, states: RestartableStates
) -> Experiment | None:
    """Return the part of an experiment between two times; None if it has too few measured values.

    A part that starts later than the experiment has its own initial states.
    """
    if not start < stop:
        return None
    outputs = tuple(_between(output, start, stop) for output in experiment.outputs)
    first = start == experiment.start
    if sum(len(o.times) for o in outputs) <= (0 if first else len(states.targets)):
        return None
    part = replace(
        experiment,
        start=start,
        stop=stop,
        outputs=outputs,
        inputs=tuple(_driving(given, start, stop) for given in experiment.inputs),
        signals=tuple(_driving(given, start, stop) for given in experiment.signals),
    )
    if first:
        return part
    begun = replace(
        part,
        id=part_name(experiment.id, start),
        record=experiment.record_id,
        own_starts=states.own_starts(part),
    )
    kept = tuple((name, v) for name, v in experiment.values if name not in states.owner)
    return replace(begun, values=kept)


def _between(output: Output, start: float, stop: float) -> Output:
    kept = output.only((output.times >= start) & (output.times <= stop))
    if output.reference is None:
        return kept
    known = output.reference
    inside = (known.times >= start) & (known.times <= stop)
    return replace(kept, reference=known.only(inside) if inside.any() else None)


def _driving(given: Input, start: float, stop: float) -> Input:
    """Return the samples of an input within a part, and the ones before and after it."""
    first = max(int(np.searchsorted(given.times, start, "right")) - 1, 0)
    behind = int(np.searchsorted(given.times, stop, "left")) + 1
    return replace(given, times=given.times[first:behind], values=given.values[first:behind])


def _said(experiment: Experiment, gap: InputGap, treatment: Treatment, why: str = "") -> RecordGap:
    return RecordGap(
        experiment.record_id, gap.first, gap.last, gap.missing, treatment, gap.moving, why,
        gap.row_step,
    )  # fmt: skip
