"""The <ModelStructure> of a model description: states, event indicators, dependencies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal
from xml.etree.ElementTree import Element

from workers.errors import ModelError
from workers.fmu.model_variables import DeclaredVariables
from workers.fmu.xml import XML, ReadingNotes, Version, flag, whole
from workers.messages import Interface


@dataclass(frozen=True)
class VariableDependency:
    """Dependencies of an output or a state derivative, as declared by the FMU.

    Attributes
    ----------
    name
        The output or derivative. For a derivative, it is the variable, such as "der(v)", not the
        state. Derivatives come in the order of `ModelStructure.states`.
    on
        Names of states, inputs and others. None if not declared, so it may depend on anything.
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
        Number of event indicators.
    outputs
        Names of the outputs, in the order of the structure.
    fault
        Why the states cannot be integrated outside the FMU, as the end of a sentence; "" if
        they can.
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
    """None if it does not name a variable."""


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
    """Read the structure; if it is missing, take derivatives in the order of their variables."""
    section = root.find("ModelStructure")
    if section is None:
        section = Element("ModelStructure")
        notes.add(
            "it has no <ModelStructure>, so its states are the variables of which another "
            "variable is the derivative"
        )
        rates = tuple(v.name for v in declared.variables.values() if v.derivative_of is not None)
        derivatives = [_StructureUnknown(section, (name,)) for name in rates]
    else:
        derivatives = list(_unknowns(section, version, "derivative", declared))
    outputs = list(_unknowns(section, version, "output", declared))
    if any(u.names is None for u in outputs):
        notes.add("outputs in its <ModelStructure> that do not name a variable are ignored")
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
    """Return the states, and a fault that makes them unusable, or ""."""
    states: list[str] = []
    for position, unknown in enumerate(derivatives, start=1):
        if unknown.names is None:
            return (), f"its state derivative {position} is not a variable"
        for name in unknown.names:
            state = declared.variables[name].derivative_of
            inner = name[4:-1] if name.startswith("der(") else ""
            if state is None and inner in declared.variables:
                state = inner
                notes.add(
                    "derivatives that do not name their state are assigned to the state in "
                    "their brackets",
                    name,
                )
            if state is None:
                return (), (
                    f"its state derivative {name!r} does not say which variable it is the "
                    "derivative of"
                )
            states.append(state)
    if len(set(states)) < len(states):
        return (), "it lists the derivative of a state twice"
    return tuple(states), ""


def _indicators(
    root: Element, section: Element, version: Version, declared: DeclaredVariables
) -> tuple[int, str]:
    if version == "2.0":
        text = root.get("numberOfEventIndicators", "0")
        count = whole(text)
        if count is None or not 0 <= count < 2**31:
            return 0, f"its number of event indicators is {text[:40]!r}, which is not usable"
        return count, ""
    found = list(_unknowns(section, version, "indicator", declared))
    if any(u.names is None for u in found):
        return 0, "one of its event indicators is not a variable"
    return sum(len(u.names or ()) for u in found), ""


def _outputs(listed: list[_StructureUnknown], declared: DeclaredVariables) -> tuple[str, ...]:
    """Return all outputs: first those of the structure, in its order."""
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
            if None not in found:  # otherwise it counts as not declared
                on = tuple(name for names in found for name in names or ())
        for name in unknown.names or ():
            yield VariableDependency(name, role, on)


_INTERFACES: dict[str, Interface] = {
    "ModelExchange": "model_exchange",
    "CoSimulation": "co_simulation",
}
_SAID = {"ModelExchange": "model exchange", "CoSimulation": "co-simulation"}


@dataclass(frozen=True)
class InterfaceOffer:
    """An interface of an FMU, and its capabilities.

    Attributes
    ----------
    identifier
        Name of its shared library.
    """

    interface: Interface
    identifier: str
    needs_execution_tool: bool
    once_per_process: bool
    can_get_set_state: bool
    provides_directional_derivatives: bool


def read_offers(root: Element, fault: str, notes: ReadingNotes) -> tuple[InterfaceOffer, ...]:
    """Read the interfaces, model exchange first. An unusable one is left out, with a note.

    `fault` is the reason why model exchange cannot be used, or "".

    Raises
    ------
    ModelError
        If no usable interface remains.
    """
    file, found = notes.file, []
    refused: list[tuple[str, str]] = []
    for tag, interface in _INTERFACES.items():
        element = root.find(tag)
        if element is None:
            continue
        identifier = element.get("modelIdentifier")
        # It names a file, so it must not contain a path
        if not identifier or not set(identifier).isdisjoint("/\\"):
            refused.append(
                (tag, f"has the modelIdentifier {identifier!r}, which is not a plain name")
            )
        elif fault and tag == "ModelExchange":
            refused.append((tag, f"cannot be used, because {fault}"))
        else:
            found.append(_offer(interface, element, identifier))
    if not found:
        raise _none_usable(root, file, refused)
    for tag, why in refused:
        notes.add(f"its {_SAID[tag]} interface {why}, and is left out")
    for offer in found:
        if offer.needs_execution_tool:
            named = " ".join((root.get("generationTool") or "").split())
            tool = named or "the tool that exported it"
            said = "co-simulation" if offer.interface == "co_simulation" else "model exchange"
            notes.add(f"its {said} interface needs {tool} on this machine")
    return tuple(found)


def _none_usable(root: Element, file: str, refused: list[tuple[str, str]]) -> ModelError:
    """Return an error that explains why no interface can be used."""
    if not refused:
        alone = root.find("ScheduledExecution") is not None
        offers = "only scheduled execution" if alone else "neither"
        return ModelError(
            f"{file}: must offer model exchange or co-simulation, but offers {offers}; export it "
            "with one of the two"
        )
    tag, why = refused[-1]
    return ModelError(
        f"{file}: its {XML} must describe a usable interface, but {_SAID[tag]} {why}; export it "
        "again"
    )


def _offer(interface: Interface, element: Element, identifier: str) -> InterfaceOffer:
    def can(*keys: str) -> bool:
        return any(flag(element.get(key)) for key in keys)

    return InterfaceOffer(
        interface=interface,
        identifier=identifier,
        needs_execution_tool=can("needsExecutionTool"),
        once_per_process=can("canBeInstantiatedOnlyOncePerProcess"),
        can_get_set_state=can("canGetAndSetFMUstate", "canGetAndSetFMUState"),
        provides_directional_derivatives=can(
            "providesDirectionalDerivative", "providesDirectionalDerivatives"
        ),
    )
