"""The <ModelStructure> of a model description: states, event indicators, dependencies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal
from xml.etree.ElementTree import Element

from workers.fmu.parsing.elements import Version
from workers.fmu.parsing.model_variables import DeclaredVariables
from workers.fmu.parsing.xml import ReadingNotes, whole


@dataclass(frozen=True)
class VariableDependency:
    """Dependencies of an output or a state derivative, as the FMU declares them.

    Attributes
    ----------
    name
        The output or derivative.
    on
        Names of states, inputs and others. None: not declared, so it may be anything.
    """

    name: str
    role: Literal["output", "derivative"]
    on: tuple[str, ...] | None


@dataclass(frozen=True)
class ModelStructure:
    """States, event indicators, outputs and dependencies of a model.

    Attributes
    ----------
    states
        Names of the continuous states, in the order of the FMU's state vector.
    event_indicators
        Their number.
    outputs
        Names of the outputs, in the order of the structure.
    fault
        Why the states cannot be integrated by others, as the end of a sentence; "" if they can.
    """

    states: tuple[str, ...]
    event_indicators: int
    outputs: tuple[str, ...]
    dependencies: tuple[VariableDependency, ...]
    fault: str


@dataclass(frozen=True)
class _StructureUnknown:
    element: Element
    names: tuple[str, ...] | None
    """None if it names no variable."""


_PATHS = {
    ("2.0", "output"): "Outputs/Unknown",
    ("2.0", "derivative"): "Derivatives/Unknown",
    ("3.0", "output"): "Output",
    ("3.0", "derivative"): "ContinuousStateDerivative",
    ("3.0", "indicator"): "EventIndicator",
}


def read_structure(
    root: Element, version: Version, declared: DeclaredVariables, notes: ReadingNotes
) -> ModelStructure:
    """Read the structure; where it is missing, derivatives are taken in their variables' order."""
    section = root.find("ModelStructure")
    if section is None:
        section = Element("ModelStructure")
        notes.add("it has no <ModelStructure>: states are those that a variable is derivative of")
        rates = tuple(v.name for v in declared.variables.values() if v.derivative_of is not None)
        derivatives = [_StructureUnknown(section, (name,)) for name in rates]
    else:
        derivatives = list(_unknowns(section, version, "derivative", declared))
    outputs = list(_unknowns(section, version, "output", declared))
    if any(u.names is None for u in outputs):
        notes.add("outputs in its <ModelStructure> that name no variable are ignored")
    indicators, indicator_fault = _indicators(root, section, version, declared)
    states, state_fault = _states(derivatives, declared, notes)
    return ModelStructure(
        states=states,
        event_indicators=indicators,
        outputs=_outputs(outputs, declared),
        dependencies=(
            *_dependencies(outputs, "output", declared),
            *_dependencies(derivatives, "derivative", declared),
        ),
        fault=state_fault or indicator_fault,
    )


def _unknowns(
    section: Element, version: Version, role: str, declared: DeclaredVariables
) -> Iterator[_StructureUnknown]:
    key = "index" if version == "2.0" else "valueReference"
    for element in section.iterfind(_PATHS[version, role]):
        at = whole(element.get(key))
        yield _StructureUnknown(element, None if at is None else declared.names_by_key.get(at))


def _states(
    derivatives: list[_StructureUnknown], declared: DeclaredVariables, notes: ReadingNotes
) -> tuple[tuple[str, ...], str]:
    """Return the states, and their fault, if any."""
    states: list[str] = []
    for position, unknown in enumerate(derivatives, start=1):
        if unknown.names is None:
            return (), f"its state derivative {position} is no variable"
        for name in unknown.names:
            state = declared.variables[name].derivative_of
            inner = name[4:-1] if name.startswith("der(") else ""
            if state is None and inner in declared.variables:
                state = inner
                notes.add("derivatives that name no state are taken for those in brackets", name)
            if state is None:
                return (), f"its state derivative {name!r} does not say of which variable it is one"
            states.append(state)
    if len(set(states)) < len(states):
        return (), "it lists the derivative of one state twice"
    return tuple(states), ""


def _indicators(
    root: Element, section: Element, version: Version, declared: DeclaredVariables
) -> tuple[int, str]:
    if version == "2.0":
        text = root.get("numberOfEventIndicators", "0")
        count = whole(text)
        if count is None or not 0 <= count < 2**31:
            return 0, f"its number of event indicators is {text[:40]!r}"
        return count, ""
    found = list(_unknowns(section, version, "indicator", declared))
    if any(u.names is None for u in found):
        return 0, "one of its event indicators is no variable"
    return sum(len(u.names or ()) for u in found), ""


def _outputs(listed: list[_StructureUnknown], declared: DeclaredVariables) -> tuple[str, ...]:
    """Return all outputs: those of the structure first, and in its order."""
    known = declared.variables
    names = [name for unknown in listed for name in unknown.names or ()]
    names += [v.name for v in known.values() if v.alias_of is None]
    return tuple(n for n in dict.fromkeys(names) if known[n].causality == "output")


def _dependencies(
    unknowns: list[_StructureUnknown],
    role: Literal["output", "derivative"],
    declared: DeclaredVariables,
) -> Iterator[VariableDependency]:
    for unknown in unknowns:
        text = unknown.element.get("dependencies")
        on: tuple[str, ...] | None = None
        if text is not None:
            found = [declared.names_by_key.get(whole(each) or 0) for each in text.split()]
            if None not in found:  # else it is as good as not declared
                on = tuple(name for names in found for name in names or ())
        for name in unknown.names or ():
            yield VariableDependency(name, role, on)
