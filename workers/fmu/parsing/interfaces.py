"""The interfaces that an FMU offers, and what it can do in each."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree.ElementTree import Element

from workers.errors import ModelError
from workers.fmu.parsing.xml import XML, ReadingNotes, flag
from workers.messages import Interface

_INTERFACES: dict[str, Interface] = {
    "ModelExchange": "model_exchange",
    "CoSimulation": "co_simulation",
}
_SAID = {"ModelExchange": "model exchange", "CoSimulation": "co-simulation"}


@dataclass(frozen=True)
class InterfaceOffer:
    """One of the interfaces that an FMU offers, and what it can do there.

    Attributes
    ----------
    identifier
        The name of its shared library.
    """

    interface: Interface
    identifier: str
    needs_execution_tool: bool
    once_per_process: bool
    can_get_set_state: bool
    provides_directional_derivatives: bool


def read_offers(root: Element, fault: str, notes: ReadingNotes) -> tuple[InterfaceOffer, ...]:
    """Read the interfaces, model exchange first. One that cannot be used is left out, with a note.

    `fault` is why model exchange cannot be used, "" if it can.

    Raises
    ------
    ModelError
        If none is left.
    """
    file, found = notes.file, []
    refused: list[tuple[str, str]] = []
    for tag, interface in _INTERFACES.items():
        element = root.find(tag)
        if element is None:
            continue
        identifier = element.get("modelIdentifier")
        # It names a file, so it must not name a folder
        if not identifier or not set(identifier).isdisjoint("/\\"):
            refused.append((tag, f"has {identifier!r} for a plain modelIdentifier"))
        elif fault and tag == "ModelExchange":
            refused.append((tag, f"cannot be used, because {fault}"))
        else:
            found.append(_offer(interface, element, identifier))
    if not found:
        raise _none_usable(root, file, refused)
    for tag, why in refused:
        notes.add(f"its interface {_SAID[tag]} {why}, and is left out")
    for offer in found:
        if offer.needs_execution_tool:
            named = " ".join((root.get("generationTool") or "").split())
            tool = named or "the tool that exported it"
            said = "co-simulation" if offer.interface == "co_simulation" else "model exchange"
            notes.add(f"its interface {said} needs {tool} on this machine")
    return tuple(found)


def _none_usable(root: Element, file: str, refused: list[tuple[str, str]]) -> ModelError:
    """Explain why no interface can be used."""
    if not refused:
        alone = root.find("ScheduledExecution") is not None
        offers = "scheduled execution alone" if alone else "neither"
        return ModelError(
            f"{file}: must offer model exchange or co-simulation but offers {offers}; export it "
            "with one of them"
        )
    tag, why = refused[-1]
    return ModelError(
        f"{file}: its {XML} must describe an interface that can be used, but {_SAID[tag]} "
        f"{why}; export it again"
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
