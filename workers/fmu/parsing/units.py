"""The <UnitDefinitions> of a model description, the same in FMI 2 and 3."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree.ElementTree import Element

from workers.fmu.parsing.xml import ReadingNotes, number, whole

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
