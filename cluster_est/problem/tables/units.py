"""Units of measured columns in their usual notations, and conversions between them.

The list is limited on purpose. pint converts 1 Hz to 9.55 rpm and an angle to a number, and it
would read the end of a column's name such as `T_in` as inches.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
UNIT_SPELLINGS = {
    "°C": "degC", "celsius": "degC", "°": "deg", "Ω": "Ohm", "ohm": "Ohm",
    "\u00b5": "u", "\u03bc": "u",  # the micro sign and the Greek letter
    "·": ".", "*": ".", "^": "", "**": "", "²": "2", "³": "3", "sec": "s", "Nm": "N.m",
    "s^-1": "1/s", "s-1": "1/s",
    "RPM": "rpm", "1/min": "rpm", "r/min": "rpm", "rev/min": "rpm", "U/min": "rpm", "min-1": "rpm",
}  # fmt: skip
UNIT_SUFFIXES = {
    "C": "degC", "Kelvin": "K", "kelvin": "K", "volt": "V", "volts": "V", "amp": "A", "amps": "A",
    "newton": "N", "newtons": "N", "pascal": "Pa", "meter": "m", "metre": "m", "meters": "m",
    "second": "s", "seconds": "s", "millis": "ms", "micros": "us", "minutes": "min",
    "hertz": "Hz", "watt": "W", "watts": "W", "joule": "J", "amperes": "A", "ampere": "A",
    "hours": "h", "radps": "rad/s", "degps": "deg/s", "mps": "m/s", "kmh": "km/h", "kph": "km/h",
    "lpm": "l/min", "percent": "%", "pct": "%",
}  # fmt: skip
"""Units at the end of a column's name, where special characters are not possible."""


@dataclass(frozen=True)
class UnitConversion:
    """A conversion to another unit: number * factor + offset."""

    factor: float
    offset: float = 0.0


@dataclass(frozen=True)
class _Unit:
    """A unit; number * factor + offset is the number in base units.

    Attributes
    ----------
    powers
        The base units with their powers, sorted by name.
    """

    powers: tuple[tuple[str, int], ...]
    factor: float = 1.0
    offset: float = 0.0

    def to(self, power: int) -> _Unit:
        """Return a power of the unit, without its offset, as in W/K or K/min."""
        raised = tuple((base, power * own) for base, own in self.powers)
        return _Unit(raised, self.factor**power)

    def times(self, other: _Unit) -> _Unit:
        """Return the product of two units."""
        powers = Counter(dict(self.powers))
        for base, own in other.powers:
            powers[base] += own
        kept = tuple(sorted((base, own) for base, own in powers.items() if own))
        return _Unit(kept, self.factor * other.factor)


_BASES = ("m", "s", "kg", "N", "Pa", "V", "A", "W", "J", "Ohm", "F", "H", "Hz", "K", "mol", "rad")
_PLAIN = _Unit(())
_UNITS = {base: _Unit(((base, 1),)) for base in _BASES}
_UNITS |= {
    prefix + base: _Unit(_UNITS[base].powers, factor)
    for base in _BASES
    if base not in ("kg", "rad")
    for prefix, factor in PREFIXES.items()
}
_UNITS |= {
    prefix + "bar": _Unit(_UNITS["Pa"].powers, factor * 1e5) for prefix, factor in PREFIXES.items()
}
_UNITS |= {
    name: _Unit(tuple((base, power) for base, power in of), factor, offset)
    for name, of, factor, offset in (
        ("cm", (("m", 1),), 1e-2, 0.0),
        ("l", (("m", 3),), 1e-3, 0.0),
        ("ml", (("m", 3),), 1e-6, 0.0),
        ("min", (("s", 1),), 60.0, 0.0),
        ("h", (("s", 1),), 3600.0, 0.0),
        ("d", (("s", 1),), 86400.0, 0.0),
        ("g", (("kg", 1),), 1e-3, 0.0),
        ("mg", (("kg", 1),), 1e-6, 0.0),
        ("ug", (("kg", 1),), 1e-9, 0.0),
        ("t", (("kg", 1),), 1e3, 0.0),
        ("hPa", (("Pa", 1),), 1e2, 0.0),
        ("kgf", (("N", 1),), 9.80665, 0.0),
        ("psi", (("Pa", 1),), 6894.757293168, 0.0),
        ("Wh", (("J", 1),), 3600.0, 0.0),
        ("kWh", (("J", 1),), 3.6e6, 0.0),
        ("Ah", (("A", 1), ("s", 1)), 3600.0, 0.0),
        ("mAh", (("A", 1), ("s", 1)), 3.6, 0.0),
        ("degC", (("K", 1),), 1.0, 273.15),
        ("degF", (("K", 1),), 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
        ("deg", (("rad", 1),), math.pi / 180.0, 0.0),
        ("rev", (("rad", 1),), 2.0 * math.pi, 0.0),
        ("rpm", (("rad", 1), ("s", -1)), math.pi / 30.0, 0.0),
        ("1", (), 1.0, 0.0),
        ("%", (), 1e-2, 0.0),
    )
}
_UNIT_POWER = re.compile(r"1|(?P<name>.*?[^\d-])(?P<power>-?\d+)?")
"""A unit and its power, such as m3 or s-2."""

_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(<]([^\[\](){}<>]*)[\])>]\s*")
_AFTER_SLASH = re.compile(r"(.*\S)\s+(?:/|in)\s+(\S+)\s*")


LIKELY = {
    "rad/s": ("rpm", "deg/s"), "rpm": ("rad/s",), "deg/s": ("rad/s",),
    "rad": ("deg",), "deg": ("rad",), "K": ("degC", "degF"), "degC": ("K", "degF"),
    "Pa": ("kPa", "bar", "hPa", "MPa"), "bar": ("Pa", "kPa", "mbar"), "kPa": ("Pa", "bar"),
    "MPa": ("bar", "kPa", "Pa"),
    "m": ("mm", "cm"), "mm": ("m",), "m/s": ("km/h", "mm/s"), "s": ("ms", "min", "h"),
    "N": ("kN", "kgf"), "W": ("kW",), "J": ("kJ", "kWh"), "V": ("mV",), "A": ("mA",),
    "mg/l": ("g/l", "ug/l"), "g/l": ("mg/l",),
    "m3/s": ("l/min", "m3/h", "l/s"), "kg/s": ("kg/h", "kg/min", "g/s"), "1": ("%",),
}  # fmt: skip
"""For each unit, other units in which a column may actually be."""


def likely_conversions(wanted: str) -> dict[str, UnitConversion]:
    """Return the conversions from units that are often mistaken for the wanted unit, by unit."""
    names = LIKELY.get(spelled(wanted), ())
    found = {name: conversion(name, wanted) for name in names}
    return {name: change for name, change in found.items() if change is not None}


def spelled(unit: str) -> str:
    """Return a unit in its usual notation."""
    text = unit.strip()
    for other, usual in UNIT_SPELLINGS.items():
        if text == other or len(other) == 1:
            text = text.replace(other, usual)
    return text


def split_unit(name: str) -> tuple[str, str]:
    """Return "force" and "N" of "force [N]"; the unit is "" if the name has no unit."""
    found = _IN_BRACKETS.fullmatch(name) or _AFTER_SLASH.fullmatch(name)
    if found is None or not found.group(1).strip():
        return name, ""
    return found.group(1).strip(), found.group(2).strip()


def column_unit(name: str, units: Mapping[str, str]) -> str:
    """Return the unit of a column in its usual notation, from `units` or its name; may be ""."""
    in_name = split_unit(name)[1]
    return spelled(units.get(name, "") or (in_name if is_known(in_name) else ""))


def is_known(unit: str) -> bool:
    """Return whether a unit is known, so that it can be converted."""
    return _parsed(spelled(unit)) is not None


def same_unit(one: str, other: str) -> bool:
    """Return whether two notations mean the same unit."""
    return spelled(one) == spelled(other)


def conversion(given: str, wanted: str) -> UnitConversion | None:
    """Return the conversion from one unit to another; None if it is not known."""
    a, b = _parsed(spelled(given)), _parsed(spelled(wanted))
    if a is None or b is None or a.powers != b.powers:
        return None
    return UnitConversion(_rounded(a.factor / b.factor), _rounded((a.offset - b.offset) / b.factor))


def _parsed(unit: str) -> _Unit | None:
    """Return a unit, or a product or quotient of units such as kg/min or J/(kg.K), if it is known.

    Everything between one slash and the next is a divisor.
    """
    if unit in _UNITS:
        return _UNITS[unit]
    found = _PLAIN
    for place, side in enumerate(unit.split("/")):
        bare = side[1:-1] if place and side.startswith("(") and side.endswith(")") else side
        for part in bare.split("."):
            own = _raised(part)
            if own is None:
                return None
            found = found.times(own.to(-1) if place else own)
    return found


def _raised(part: str) -> _Unit | None:
    """Return a unit with its power."""
    read = _UNIT_POWER.fullmatch(part)
    name = (read["name"] or "1") if read is not None else ""
    if read is None or name not in _UNITS:
        return None
    return _UNITS[name].to(int(read["power"] or 1))


def _rounded(number: float) -> float:
    """Return a number rounded to 12 digits, to remove rounding errors."""
    return float(f"{number:.12g}")
