"""Elements of a model description that are variables, and their types."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal
from xml.etree.ElementTree import Element

from workers.fmu.parsing.xml import ReadingNotes, number, whole
from workers.fmu.variable import KINDS, Type

Version = Literal["2.0", "3.0"]

TYPES: dict[Version, dict[str, Type]] = {
    "2.0": {
        "Real": "Float64",
        "Integer": "Int32",
        "Enumeration": "Int32",
        "Boolean": "Boolean",
        "String": "String",
    },
    "3.0": {name: name for name in KINDS},
}
"""Names of types in the XML."""
NOTHING = Element("nothing")


@dataclass(frozen=True)
class RawVariable:
    """A variable's elements in the XML: its own, the one of its type (FMI 3: the same)."""

    own: Element
    value: Element
    tag: str
    key: int
    """Position (FMI 2) or value reference (FMI 3), by which other parts refer to it."""
    name: str
    reference: int


def raw_variables(root: Element, version: Version, notes: ReadingNotes) -> list[RawVariable]:
    """Return the usable variables; in FMI 2, the others still count for positions."""
    section = root.find("ModelVariables")
    types = TYPES[version]
    found = []
    if section is None:
        notes.add("it has no <ModelVariables>")
    elements = [] if section is None else list(section)
    if version == "2.0":
        elements = [e for e in elements if e.tag == "ScalarVariable"]
    for position, own in enumerate(elements, start=1):
        value: Element | None = own
        if version == "2.0":
            value = next((child for child in own if child.tag in types), None)
        name, reference = own.get("name"), whole(own.get("valueReference"))
        label = name or f"variable {position}"
        if value is None or value.tag not in types:
            notes.add("variables without a type of FMI are left out", label)
        elif not name:
            notes.add("variables without a name are left out", label)
        elif reference is None or not 0 <= reference < 2**32:
            notes.add("variables without a valueReference of 32 bits are left out", label)
        else:
            key = position if version == "2.0" else reference
            found.append(RawVariable(own, value, value.tag, key, name, reference))
    return found


def declared_types(root: Element, version: Version) -> dict[str, Element]:
    """Return the element with the attributes of each declared type, by its name."""
    found = {}
    for definition in root.iterfind("TypeDefinitions/*"):
        holds = definition
        if version == "2.0":
            holds = next((child for child in definition if child.tag in TYPES[version]), NOTHING)
        found[definition.get("name", "")] = holds
    return found


BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""In the order of the powers of a definition."""


@dataclass(frozen=True)
class UnitDefinition:
    """A unit as the FMU defines it, by powers of the base units of the SI and the radian.

    Attributes
    ----------
    powers
        In the order of `BASE_UNITS`.
    offset
        Of its zero, in the base unit: 273.15 for degrees Celsius.
    """

    powers: tuple[int, ...]
    offset: float = 0.0


def read_units(root: Element, notes: ReadingNotes) -> dict[str, UnitDefinition]:
    """Read the units that have a definition in base units, by name; others are names alone."""
    found: dict[str, UnitDefinition] = {}
    for unit in root.findall("UnitDefinitions/Unit"):
        name, base = unit.get("name"), unit.find("BaseUnit")
        if not name or base is None:
            continue
        powers = [whole(base.get(key, "0")) for key in BASE_UNITS]
        offset = number(base.get("offset"), notes, "offset", name)
        if None in powers:
            notes.add("units with powers that are no whole numbers count as names alone", name)
            continue
        found.setdefault(name, UnitDefinition(tuple(p or 0 for p in powers), offset or 0.0))
    return found
