"""Units by their usual spellings, and conversions between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
PREFIXED = ("m", "s", "N", "Pa", "V", "A", "W", "J", "Ohm", "F", "H", "Hz", "K", "N.m", "bar")
SPELLINGS = {
    "°C": "degC", "celsius": "degC", "°": "deg", "Ω": "Ohm", "ohm": "Ohm",
    "\u00b5": "u", "\u03bc": "u",  # the micro sign and the Greek letter
    "·": ".", "*": ".", "^": "", "**": "", "²": "2", "³": "3", "sec": "s", "Nm": "N.m",
    "s^-1": "1/s", "s-1": "1/s",
    "RPM": "rpm", "1/min": "rpm", "r/min": "rpm", "rev/min": "rpm", "U/min": "rpm", "min-1": "rpm",
}  # fmt: skip
WORDS = {
    "C": "degC", "Kelvin": "K", "kelvin": "K", "volt": "V", "volts": "V", "amp": "A", "amps": "A",
    "newton": "N", "pascal": "Pa", "meter": "m", "metre": "m", "seconds": "s", "minutes": "min",
    "hours": "h", "radps": "rad/s", "degps": "deg/s", "mps": "m/s", "kmh": "km/h", "kph": "km/h",
    "lpm": "l/min", "percent": "%", "pct": "%",
}  # fmt: skip
"""Units at the end of a column's name, as they are written where no signs can be."""


@dataclass(frozen=True)
class UnitConversion:
    """`factor` times the number, plus `offset`, is the number in the other unit."""

    factor: float
    offset: float = 0.0


@dataclass(frozen=True)
class _BaseUnit:
    """A number in the base unit is `factor` times the number, plus `offset`."""

    base: str
    factor: float = 1.0
    offset: float = 0.0


_UNITS = {
    "cm": _BaseUnit("m", 1e-2),
    "min": _BaseUnit("s", 60.0),
    "h": _BaseUnit("s", 3600.0),
    "kg": _BaseUnit("kg"),
    "g": _BaseUnit("kg", 1e-3),
    "t": _BaseUnit("kg", 1e3),
    "hPa": _BaseUnit("Pa", 1e2),
    "Wh": _BaseUnit("J", 3600.0),
    "kWh": _BaseUnit("J", 3.6e6),
    "degC": _BaseUnit("K", 1.0, 273.15),
    "degF": _BaseUnit("K", 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
    "psi": _BaseUnit("Pa", 6894.757293168),
    "rad": _BaseUnit("rad"),
    "deg": _BaseUnit("rad", math.pi / 180.0),
    "rad/s": _BaseUnit("rad/s"),
    "deg/s": _BaseUnit("rad/s", math.pi / 180.0),
    "rpm": _BaseUnit("rad/s", math.pi / 30.0),
    "m/s": _BaseUnit("m/s"),
    "mm/s": _BaseUnit("m/s", 1e-3),
    "km/h": _BaseUnit("m/s", 1.0 / 3.6),
    "m3/s": _BaseUnit("m3/s"),
    "m3/h": _BaseUnit("m3/s", 1.0 / 3600.0),
    "l/s": _BaseUnit("m3/s", 1e-3),
    "l/min": _BaseUnit("m3/s", 1e-3 / 60.0),
    "kg/s": _BaseUnit("kg/s"),
    "kg/h": _BaseUnit("kg/s", 1.0 / 3600.0),
    "1": _BaseUnit("1"),
    "%": _BaseUnit("1", 1e-2),
} | {
    prefix + base: _BaseUnit("Pa", factor * 1e5) if base == "bar" else _BaseUnit(base, factor)
    for base in PREFIXED
    for prefix, factor in PREFIXES.items()
}


LIKELY = {
    "rad/s": ("rpm", "deg/s"), "rpm": ("rad/s",), "deg/s": ("rad/s",),
    "rad": ("deg",), "deg": ("rad",), "K": ("degC",), "degC": ("K",),
    "Pa": ("kPa", "bar", "hPa", "MPa"), "bar": ("Pa", "kPa"), "kPa": ("Pa", "bar"),
    "m": ("mm", "cm"), "mm": ("m",), "m/s": ("km/h", "mm/s"), "s": ("ms", "min", "h"),
    "N": ("kN",), "W": ("kW",), "J": ("kJ", "kWh"), "V": ("mV",), "A": ("mA",),
    "m3/s": ("l/min", "m3/h", "l/s"), "kg/s": ("kg/h",), "1": ("%",),
}  # fmt: skip
"""Units in which a column may be that is taken for one in another unit."""


def likely_conversions(wanted: str) -> dict[str, UnitConversion]:
    """Return the conversions from units that are often mistaken for one, by unit."""
    names = LIKELY.get(spelled(wanted), ())
    found = {name: conversion(name, wanted) for name in names}
    return {name: change for name, change in found.items() if change is not None}


def spelled(unit: str) -> str:
    """Return a unit in its usual spelling."""
    text = unit.strip()
    for other, usual in SPELLINGS.items():
        if text == other or len(other) == 1:
            text = text.replace(other, usual)
    return text


def is_known(unit: str) -> bool:
    """Return whether a unit can be converted at all."""
    return spelled(unit) in _UNITS


def same_unit(one: str, other: str) -> bool:
    """Return whether two spellings mean the same unit."""
    return spelled(one) == spelled(other)


def conversion(given: str, wanted: str) -> UnitConversion | None:
    """Return the conversion from one unit to another; None if it is not known."""
    a, b = _UNITS.get(spelled(given)), _UNITS.get(spelled(wanted))
    if a is None or b is None or a.base != b.base:
        return None
    return UnitConversion(_rounded(a.factor / b.factor), _rounded((a.offset - b.offset) / b.factor))


def _rounded(number: float) -> float:
    """Return a number without the rounding of its last digits."""
    return float(f"{number:.12g}")
