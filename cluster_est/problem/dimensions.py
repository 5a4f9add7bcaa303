"""Dimensions of physical quantities, from the text of a unit or from its definition in an FMU.

A dimension contains the powers of the base units in a unit; it does not depend on the size of the
unit. The angle has its own power, so the speed of a shaft differs from a rate.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING

from workers.effects.site import is_difference, parts_of
from workers.fmu.description import ModelDescription
from workers.fmu.xml import UnitDefinition

if TYPE_CHECKING:  # slow to import, and most runs do not need it
    import pint

BASES = ("mass", "length", "time", "current", "temperature", "substance", "luminosity", "angle")
"""Base quantities in the order of an FMU's unit definitions, with the names of pint."""


@dataclass(frozen=True)
class Dimension:
    """The powers of `BASES` in a unit.

    Attributes
    ----------
    powers
        Powers in the order of `BASES`.
    absolute
        Whether 0 in the unit is 0 of the quantity; false for degrees Celsius.
    """

    powers: tuple[float, ...]
    absolute: bool = True

    def same_as(self, *others: Dimension) -> bool:
        """Return whether the powers equal those of one of the others; zeros may differ."""
        return any(self.powers == other.powers for other in others)

    @property
    def is_rate(self) -> bool:
        """Whether the quantity is a rate, such as a speed or a flow."""
        return self.powers[BASES.index("time")] == -1.0

    @property
    def without_angle(self) -> tuple[float, ...]:
        """The powers without that of the angle, which many tools leave out."""
        return self.powers[:-1]


def dimension(**powers: float) -> Dimension:
    """Return the dimension with these powers, such as `dimension(length=1, time=-1)`."""
    return Dimension(tuple(float(powers.get(name, 0.0)) for name in BASES))


def integral_of(rate: Dimension) -> Dimension:
    """Return the dimension of the integral of a quantity over time."""
    powers = zip(BASES, rate.powers, strict=True)
    return Dimension(tuple(power + (name == "time") for name, power in powers))


NUMBER = dimension()
LENGTH, ANGLE = dimension(length=1), dimension(angle=1)
SPEED, TURNING = dimension(length=1, time=-1), dimension(angle=1, time=-1)
ACCELERATION, TURNING_FASTER = dimension(length=1, time=-2), dimension(angle=1, time=-2)
MASS, AMOUNT = dimension(mass=1), dimension(substance=1)
FORCE = dimension(mass=1, length=1, time=-2)
TORQUE = dimension(mass=1, length=2, time=-2)
TEMPERATURE = dimension(temperature=1)
AREA, VOLUME = dimension(length=2), dimension(length=3)
PRESSURE = dimension(mass=1, length=-1, time=-2)
FLOW, MASS_FLOW = dimension(length=3, time=-1), dimension(mass=1, time=-1)
POWER, HEAT_FLUX = dimension(mass=1, length=2, time=-3), dimension(mass=1, time=-3)
CURRENT, CHARGE = dimension(current=1), dimension(current=1, time=1)
DENSITY, CONCENTRATION = dimension(mass=1, length=-3), dimension(substance=1, length=-3)
ENERGY, MOMENTUM = TORQUE, dimension(mass=1, length=1, time=-1)

BALANCED = (
    VOLUME, MASS, AMOUNT, CHARGE, ENERGY, MOMENTUM, SPEED, TURNING, TEMPERATURE, PRESSURE, DENSITY,
    CONCENTRATION,
)  # fmt: skip
"""Quantities that are conserved, and those that measure how much of such a quantity there is."""


class KnownUnits:
    """Units of variables and signals, as dimensions.

    Parameters
    ----------
    description
        Description of the FMU, with the units that a config gives to its variables.
    given
        Units from a config, by variable or signal.
    """

    def __init__(self, description: ModelDescription, given: Mapping[str, str]) -> None:
        self._description, self._given = description, given

    def unit(self, name: str) -> str:
        """Return the unit of a variable, a signal or a difference "a - b"; "" if none is known."""
        name = name if self._has(name) else parts_of(name)[0]
        if name in self._description.variables:
            return self._description.variables[name].unit
        return self._given.get(name, "")

    def of(self, name: str) -> Dimension | None:
        """Return the dimension of a variable, a signal or a difference; None if it is unknown.

        A difference has a dimension only if both of its variables have the same dimension.
        """
        if not self._has(name) and is_difference(name):
            first, second, *_ = parts_of(name)
            one, other = self.of(first), self.of(second)
            return one if one is not None and one == other else None
        return dimension_of(self.unit(name), self._description.units)

    def _has(self, name: str) -> bool:
        return name in self._description.variables or name in self._given


def dimension_of(unit: str, definitions: Mapping[str, UnitDefinition]) -> Dimension | None:
    """Return the dimension of a unit from its definition in an FMU, or from its text.

    If both are known and differ in more than the angle, return None. Tools often leave out the
    angle.
    """
    by_text = _dimension_of_text(unit)
    definition = definitions.get(unit)
    if definition is None:
        return by_text
    defined = Dimension(tuple(map(float, definition.powers)), absolute=definition.offset == 0.0)
    if by_text is None:
        return defined
    if by_text.without_angle != defined.without_angle:
        return None
    return by_text if by_text.powers[-1] else defined


LONGEST_UNIT = 60
"""Largest number of characters in a unit; a longer text is not a unit."""
SPELLINGS = {
    "°C": "degC", "℃": "degC", "°F": "degF", "°": "deg", "Ω": "ohm", "\u2126": "ohm",
    "\u00b5": "u", "\u03bc": "u", "·": "*", "\u22c5": "*", "²": "2", "³": "3", "⁻": "-", "¹": "1",
    "^": "**", "\u2212": "-",
}  # fmt: skip
WORDS = {
    "Ohm": "ohm", "Nm": "N*m", "Ns": "N*s", "Cel": "degC", "RPM": "rpm", "rev": "revolution",
    "sec": "s", "Celsius": "degC", "Kelvin": "kelvin",
}  # fmt: skip
KNOWN_NAMES = frozenset({
    "meter", "inch", "foot", "mile", "gram", "metric_ton", "pound", "second", "minute", "hour",
    "day", "ampere", "kelvin", "degree_Celsius", "degree_Fahrenheit", "degree_Rankine", "mole",
    "candela", "lumen", "lux", "radian", "degree", "revolution", "turn",
    "revolutions_per_minute", "hertz", "newton", "kilogram_force", "force_kilogram", "pound_force",
    "force_pound", "pascal", "bar", "standard_atmosphere", "pound_force_per_square_inch", "torr",
    "joule", "watt_hour", "calorie", "electron_volt", "watt", "metric_horsepower", "volt", "ohm",
    "siemens", "farad", "henry", "coulomb", "ampere_hour", "weber", "tesla", "liter", "percent",
    "ppm", "knot", "kilometer_per_hour", "mile_per_hour", "poise", "stokes", "dimensionless",
})  # fmt: skip
"""Units of measurements. pint knows more units, and reads "pu" as a very small mass."""
ANGLES = frozenset({"radian", "degree", "revolution", "turn", "revolutions_per_minute"})
"""Units of angles, which pint treats as dimensionless."""
RELATIVE = frozenset({"degree_Celsius", "degree_Fahrenheit"})
"""Units in which 0 is not 0 of the quantity."""
AMBIGUOUS = re.compile(r"\b(C|F|pH)\b")
"""Texts that pint reads as coulomb, farad and picohenry, but that may mean °C, °F and acidity."""
_EXPONENT = re.compile(r"(?<=[A-Za-z%)])(-?\d+)")
_POINT = re.compile(r"(?<=[A-Za-z)\d])\.(?=[A-Za-z(])")
_ALLOWED = re.compile(r"[\w*/(). +\-%]*", re.ASCII)
_TOO_MUCH = re.compile(r"\d{4}|\*\*\s*-?[\d.]+\s*\*\*|\*\*\s*\(")


@lru_cache(maxsize=1024)
def _dimension_of_text(unit: str) -> Dimension | None:
    """Return the dimension of a unit such as "m/s2", "degC" or "W/(m2.K)"; None if it is unknown.

    "1" and "%" are dimensionless. An empty text may mean anything, so its dimension is unknown.
    """
    text = unit.strip()
    if not text or len(text) > LONGEST_UNIT:
        return None
    if text in ("1", "%"):
        return NUMBER
    text = _spelled(text)
    if not _ALLOWED.fullmatch(text) or _TOO_MUCH.search(text) or AMBIGUOUS.search(text):
        return None
    registry = _registry()
    try:
        found = registry.Unit(text)
        powers = {str(base): float(str(own)) for base, own in found.dimensionality.items()}
        parts = [
            (registry.parse_unit_name(name)[0][1], float(str(own)))
            for name, own in found._units.items()
        ]
    except Exception:  # a text that is not a unit may fail in any part of pint's parser
        return None
    names = {name for name, _ in parts}
    if not names <= KNOWN_NAMES:
        return None
    powers["[angle]"] = sum(own for name, own in parts if name in ANGLES)
    absolute = not names & RELATIVE
    return Dimension(tuple(powers.get(f"[{base}]", 0.0) for base in BASES), absolute)


def _spelled(unit: str) -> str:
    """Return a unit in the notation of pint."""
    for sign, usual in SPELLINGS.items():
        unit = unit.replace(sign, usual)
    unit = _EXPONENT.sub(r"**\1", _POINT.sub("*", unit))
    return re.sub(r"[A-Za-z]+", lambda m: WORDS.get(m.group(), m.group()), unit)


@cache
def _registry() -> pint.UnitRegistry[float]:
    """Return the unit registry of pint."""
    import pint

    return pint.UnitRegistry()
