"""Layout of the exported FMU: its variables in the original, or in arrays of the wrapper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from cluster_est.errors import ModelError
from cluster_est.model_export.repaired_model import EstimatedValue, RepairedModel
from workers.effects.compiled import CompiledEquations, equations
from workers.effects.definition import EffectDefinition
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable, Type
from workers.simulation.integrator import DEFAULT_RTOL

_SAME: tuple[Type, ...] = ("Float64", "Int32", "Boolean", "String")
"""Types that exist in FMI 2.0, some with another name."""
_LEAST, _MOST = -(2.0**31), 2.0**31 - 1.0
"""Limits of the integers of FMI 2.0."""


@dataclass(frozen=True)
class TranslatedVariable:
    """A variable of the original that has another form in FMI 2.0.

    Attributes
    ----------
    first, size
        References of its elements in the exported FMU: `size` consecutive ones from `first` on.
    type, reference
        Type and reference in the original.
    starts
        Start values of the elements of a settable array, () for others.
    """

    first: int
    size: int
    type: Type
    reference: int
    starts: tuple[float, ...]


def flatten(
    description: ModelDescription, structure: Mapping[str, int]
) -> tuple[ModelDescription, tuple[TranslatedVariable, ...], tuple[str, ...]]:
    """Give each element of an array a reference, and omit variables without a type in FMI 2.0.

    A description of FMI 2.0 is not changed.

    Parameters
    ----------
    structure
        Values of structural parameters that differ from their start values.

    Returns
    -------
    description, translated, left_out
        The description with references of the exported FMU; translated variables in the order of
        their first references; names of variables that FMI 2.0 cannot express.
    """
    if description.version == "2.0":
        return description, (), ()
    groups: dict[int, list[ModelVariable]] = {}
    for variable in description.variables.values():
        groups.setdefault(variable.reference, []).append(variable)
    free = 1 + max(groups, default=0)
    kept: dict[str, ModelVariable] = {}
    translated, left_out = [], list[str]()
    for reference, group in groups.items():
        own = [v for v in group if v.alias_of is None]
        if not _expressible(own):
            left_out += [v.name for v in group]
            continue
        one = own[0]
        first = reference if one.size == 1 else free
        free += one.size if one.size > 1 else 0
        if one.size > 1 or one.type not in _SAME:
            starts = tuple(v.start or 0.0 for v in own) if one.size > 1 and one.settable else ()
            translated.append(TranslatedVariable(first, one.size, one.type, reference, starts))
        for v in group:
            start = structure.get(v.name, v.start)
            kept[v.name] = replace(v, reference=first + v.element, start=start)
    ordered = {name: kept[name] for name in description.variables if name in kept}
    translated.sort(key=lambda each: each.first)
    return replace(description, variables=ordered), tuple(translated), tuple(left_out)


def _expressible(elements: list[ModelVariable]) -> bool:
    """Return whether FMI 2.0 can express a variable, judged by its start values."""
    kind, size = elements[0].kind, elements[0].size
    if kind == "integer":
        return all(_LEAST <= (v.start or 0.0) <= _MOST for v in elements)
    return kind in ("real", "boolean") or (kind == "string" and size == 1)


def fits(limit: float | None) -> bool:
    """Return whether a limit is within the range of FMI 2.0's integers."""
    return limit is not None and _LEAST <= limit <= _MOST


Kind = Literal["INPUT", "SIGNAL", "COEFFICIENT", "BASE", "START", "RATE", "OUTPUT", "STATE"]
"""Kinds of values of references, in the order of `table.h`."""


@dataclass(frozen=True)
class AddedVariable:
    """A variable that the original does not have.

    Attributes
    ----------
    kind
        "SIGNAL" (an input), "COEFFICIENT" (a tunable parameter), "STATE" or "RATE" (its
        derivative).
    index
        Index in the wrapper's array of that kind.
    state
        For a derivative, the name of its state.
    """

    name: str
    reference: int
    kind: Kind
    index: int
    description: str
    value: EstimatedValue | None = None
    state: str = ""


@dataclass(frozen=True)
class AnsweredReference:
    """A reference of a real variable whose value the wrapper provides.

    `start` is the index of its start value among those of the run; -1 if it has none.
    """

    reference: int
    kind: Kind
    index: int
    start: int = -1


@dataclass(frozen=True)
class WrapperLayout:
    """The variables of the exported FMU and of the original, and the wrapper's arrays.

    Attributes
    ----------
    repair
        The exported model; its description has the references of the exported FMU.
    exchange
        Whether the original uses model exchange.
    inputs
        The original's real inputs: float64 scalars first, and among them those that may change
        between events first.
    signals
        Measured signals that effects need; they become additional inputs.
    memories, inner, outputs
        Indices of the effects that change a complete input signal, that act during the simulation,
        and that act at outputs.
    equations
        Equations of the effects that act during the simulation.
    row
        Variables that effects at outputs need.
    starts
        Start values of the original's variables in the exported FMU.
    added
        Variables that the original does not have.
    answered
        References provided by the wrapper, in ascending order.
    affected
        References of variables that effects use or change.
    translated, left_out
        Variables that have another form in FMI 2.0, and variables that FMI 2.0 cannot express.
    """

    repair: RepairedModel
    exchange: bool
    inputs: tuple[ModelVariable, ...]
    signals: tuple[str, ...]
    memories: tuple[int, ...]
    inner: tuple[int, ...]
    outputs: tuple[int, ...]
    equations: CompiledEquations
    row: tuple[str, ...]
    starts: tuple[EstimatedValue, ...]
    added: tuple[AddedVariable, ...]
    answered: tuple[AnsweredReference, ...]
    affected: tuple[int, ...]
    translated: tuple[TranslatedVariable, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """The original's states, which come first among all states."""
        return self.repair.description.states if self.exchange else ()

    @property
    def n_inner_states(self) -> int:
        """Number of states, without those of effects at outputs."""
        return len(self.states) + len(self.equations.start_states)

    def is_plain(self, variable: ModelVariable) -> bool:
        """Return whether a variable keeps its type and its reference."""
        return _is_plain(variable, self.translated)

    @property
    def columns(self) -> tuple[str, ...]:
        """Inputs, then signals."""
        return (*(v.name for v in self.inputs), *self.signals)

    @property
    def tolerance(self) -> float:
        """The relative tolerance of the run's integration."""
        solver = self.repair.problem.model.solver
        rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
        return min(rtol, DEFAULT_RTOL) if solver.name == "cvode" else rtol

    def effect(self, index: int) -> EffectDefinition:
        return self.repair.effects[index]

    def reference(self, name: str) -> int:
        return self.repair.description.variables[name].reference

    def first_output_state(self, index: int) -> int:
        """Return the index of the first own state of an effect at an output."""
        before = (*self.inner, *self.outputs[: self.outputs.index(index)])
        return len(self.states) + sum(len(self.effect(i).states) for i in before)


def lay_out(repair: RepairedModel) -> WrapperLayout:
    """Return the layout of the exported FMU.

    Raises
    ------
    ModelError
        If an effect is at an input that is not real, or the run needs a variable that FMI 2.0
        cannot express.
    """
    structure = dict(repair.problem.model.structure)
    description, translated, left_out = flatten(repair.description, structure)
    _check_needed(repair, left_out)
    repair = replace(repair, description=description)
    exchange = repair.problem.model.interface == "model_exchange"
    effects = repair.effects
    memories = [i for i, e in enumerate(effects) if e.form.memory and e.site.kind == "input"]
    outputs = [i for i, e in enumerate(effects) if e.site.kind == "output"]
    inner = [i for i in range(len(effects)) if i not in (*memories, *outputs)]
    inputs = tuple(
        sorted(
            _inputs(description), key=lambda v: (not _is_plain(v, translated), not v.is_continuous)
        )
    )
    if not exchange:
        _refuse_read(effects, description)
    signals = _signals(effects, description)
    columns = (*(v.name for v in inputs), *signals)
    _check_inputs(effects, description, columns)
    compiled = equations(
        tuple(effects[i] for i in inner),
        tuple(repair.positions[i] for i in inner),
        description.states if exchange else (),
        columns,
    )
    known = [f for f in _starts(repair) if f.name not in compiled.parameters]
    order = sorted(inner, key=lambda i: effects[i].site.at_rates)
    added = _added(repair, signals, [*order, *outputs], exchange=exchange)
    needed = [n for i in outputs for n in (*effects[i].uses, effects[i].site.target)]
    row = tuple(dict.fromkeys(n for n in needed if n not in columns))
    layout = WrapperLayout(
        repair, exchange, inputs, signals, tuple(memories), tuple(inner), tuple(outputs), compiled,
        row, tuple(known), added, (), (), translated, left_out,
    )  # fmt: skip
    answered, affected = _answered(layout)
    return replace(layout, answered=answered, affected=affected)


def _signals(
    effects: tuple[EffectDefinition, ...], description: ModelDescription
) -> tuple[str, ...]:
    """Return the measured signals on which effects depend."""
    used = (name for effect in effects for name in effect.uses)
    return tuple(dict.fromkeys(name for name in used if name not in description.variables))


def _refuse_read(effects: tuple[EffectDefinition, ...], description: ModelDescription) -> None:
    """Refuse effects that depend on computed variables of an FMU for co-simulation."""
    for effect in effects:
        read = [n for n in effect.uses if (v := description.variables.get(n)) and v.is_read]
        if effect.site.kind != "output" and read:
            raise ModelError(
                f"--fmu: effect {effect.effect.name!r} at {effect.site} must not depend on a "
                f"variable that an FMU for co-simulation computes, but depends on {read[0]!r}; use "
                "--ssv, --modelica or --text, or model exchange"
            )


def _check_needed(repair: RepairedModel, left_out: tuple[str, ...]) -> None:
    """Refuse variables that the wrapper's FMI 2.0 cannot express."""
    problem = repair.problem
    named = [found.name for found in repair.parameters] + [name for name, _ in repair.known]
    for effect in repair.effects:
        named += [*effect.uses, *effect.site.targets]
    for experiment in problem.experiments:
        named += [given.variable for given in experiment.inputs] + list(experiment.recorded)
    for name, value in repair.known:
        if repair.description.variables[name].kind == "integer" and not fits(float(value)):
            left_out = (*left_out, name)
    for name in named:
        if name in left_out:
            kind = repair.description.variables[name].type
            raise ModelError(
                f"--fmu: all variables that the run uses must exist in FMI 2.0, but {name!r} is a "
                f"{kind} of FMI 3.0, which has no equivalent there; use --ssv, --modelica or --text"
            )


def _inputs(description: ModelDescription) -> tuple[ModelVariable, ...]:
    real = {v.reference: v for v in reversed(description.inputs()) if v.kind == "real"}
    return tuple(v for v in description.inputs() if real.get(v.reference) is v)


def _is_plain(variable: ModelVariable, translated: tuple[TranslatedVariable, ...]) -> bool:
    return not any(0 <= variable.reference - each.first < each.size for each in translated)


def _check_inputs(
    effects: tuple[EffectDefinition, ...], description: ModelDescription, columns: tuple[str, ...]
) -> None:
    for effect in effects:
        named = (*effect.uses, *((effect.site.target,) if effect.site.kind == "input" else ()))
        for name in named:
            variable = description.variables.get(name)
            if variable is not None and variable.causality == "input" and name not in columns:
                raise ModelError(
                    f"--fmu: effect {effect.effect.name!r}: the input {name!r} must be a real "
                    f"variable to be exported, but is of type {variable.kind}; use --ssv, "
                    "--modelica or --text"
                )


def _starts(repair: RepairedModel) -> list[EstimatedValue]:
    """Return the real start values of the original."""
    description = repair.description
    found = list(repair.parameters)
    for name, value in repair.known:
        if description.variables[name].kind == "real":
            found.append(EstimatedValue(name, description.variables[name].unit, float(value)))
    return found


def _added(
    repair: RepairedModel, signals: tuple[str, ...], stateful: list[int], *, exchange: bool
) -> tuple[AddedVariable, ...]:
    """Return the new variables; their references follow those of the original's real variables."""
    variables = repair.description.variables.values()
    reference = 1 + max((v.reference for v in variables if v.kind == "real"), default=0)
    inputs = sum(v.kind == "real" for v in _inputs(repair.description))
    rows: list[tuple[str, Kind, int, str, EstimatedValue | None, str]] = [
        (name, "SIGNAL", inputs + i, "a measured signal that an effect depends on", None, "")
        for i, name in enumerate(signals)
    ]
    for effect, values, at in zip(
        repair.effects, repair.coefficients, repair.positions, strict=True
    ):
        what = f"coefficient of effect {effect.form.name} at {effect.site}"
        for i, value in enumerate(values):
            text = f"{what}; {value.interval}" if value.interval else what
            rows.append((value.name, "COEFFICIENT", at + i, text, value, ""))
    at = len(repair.description.states) if exchange else 0
    for i in stateful:
        effect = repair.effects[i]
        for own in effect.form.states:
            name, text = f"{effect.effect.name}.{own.name}", f"state of effect {effect.form.name}"
            rows.append((name, "STATE", at, text, None, ""))
            if exchange:
                rows.append((f"der({name})", "RATE", at, f"derivative of {name}", None, name))
            at += 1
    return tuple(
        AddedVariable(name, reference + i, kind, index, text, value, state)
        for i, (name, kind, index, text, value, state) in enumerate(rows)
    )


def _answered(layout: WrapperLayout) -> tuple[tuple[AnsweredReference, ...], tuple[int, ...]]:
    description = layout.repair.description
    found = {
        own.reference: AnsweredReference(own.reference, own.kind, own.index) for own in layout.added
    }

    def add(reference: int, kind: Kind, index: int) -> None:
        found.setdefault(reference, AnsweredReference(reference, kind, index))

    for i, variable in enumerate(layout.inputs):
        add(variable.reference, "INPUT", i)
    for i, name in enumerate(layout.equations.parameters):
        add(layout.reference(name), "BASE", i)
    for i, known in enumerate(layout.starts):
        reference = layout.reference(known.name)
        found.setdefault(reference, AnsweredReference(reference, "START", i, i))
    for i in layout.outputs:
        target = layout.effect(i).site.target
        reference, row = layout.reference(target), layout.row.index(target)
        before = found.get(reference)
        if before is not None and before.kind == "START":  # a state that a sensor shows
            found[reference] = replace(before, kind="OUTPUT", index=row)
        add(reference, "OUTPUT", row)
    rate_targets = [t for i in layout.inner if layout.effect(i).site.at_rates
             for t in layout.effect(i).site.targets]  # fmt: skip
    for variable in description.variables.values():
        if variable.derivative_of in rate_targets:
            add(variable.reference, "RATE", layout.states.index(variable.derivative_of))
    named = [n for e in layout.repair.effects for n in e.uses]
    named += [e.site.target for e in layout.repair.effects if not e.site.at_rates]
    affected = {s.reference for s in found.values() if s.kind not in ("INPUT", "START")}
    affected |= {layout.reference(name) for name in named if name in description.variables}
    order = sorted(found.values(), key=lambda special: special.reference)
    return tuple(order), tuple(sorted(affected))
