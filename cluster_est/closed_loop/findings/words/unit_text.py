"""A unit's text as a dimension: "m/s2", "rad/s", "degC", "W/(m2.K)", "km/h"."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING

from cluster_est.closed_loop.findings.words.dimensions import ANGLE, NUMBER, TURNING, Dimension

if TYPE_CHECKING:  # it is slow to import, and most runs have no use for it
    import pint

LONGEST = 60
"""Signs of a unit's text; what is longer is none."""

SPELLINGS = {
    "°C": "degC", "℃": "degC", "°F": "degF", "°": "deg", "Ω": "ohm", "\u2126": "ohm",
    "\u00b5": "u", "\u03bc": "u", "·": "*", "\u22c5": "*", "²": "2", "³": "3", "⁻": "-", "¹": "1",
    "^": "**", "\u2212": "-",
}  # fmt: skip
WORDS = {
    "Ohm": "ohm", "Nm": "N*m", "Ns": "N*s", "Cel": "degC", "RPM": "rpm", "rev": "revolution",
    "sec": "s", "Celsius": "degC", "Kelvin": "kelvin",
}  # fmt: skip
KNOWN = frozenset({
    "meter", "inch", "foot", "mile", "gram", "metric_ton", "pound", "second", "minute", "hour",
    "day", "ampere", "kelvin", "degree_Celsius", "degree_Fahrenheit", "degree_Rankine", "mole",
    "candela", "lumen", "lux", "radian", "degree", "revolution", "turn",
    "revolutions_per_minute", "hertz", "newton", "kilogram_force", "force_kilogram", "pound_force",
    "force_pound", "pascal", "bar", "standard_atmosphere", "pound_force_per_square_inch", "torr",
    "joule", "watt_hour", "calorie", "electron_volt", "watt", "metric_horsepower", "volt", "ohm",
    "siemens", "farad", "henry", "coulomb", "ampere_hour", "weber", "tesla", "liter", "percent",
    "ppm", "knot", "kilometer_per_hour", "mile_per_hour", "poise", "stokes", "dimensionless",
})  # fmt: skip
"""Units that measurements come in; pint knows more, and reads "pu" as a tiny mass."""
AMBIGUOUS = re.compile(r"\b(C|F|pH)\b")
"""For pint coulomb, farad and picohenry; but people write Celsius, Fahrenheit and acidity so."""
ANGLES = {
    "radian": ANGLE, "degree": ANGLE, "revolution": ANGLE, "turn": ANGLE,
    "revolutions_per_minute": TURNING,
}  # fmt: skip
"""For pint an angle is a plain number."""
PINT = (
    "[mass]", "[length]", "[time]", "[current]", "[temperature]", "[substance]", "[luminosity]",
)  # fmt: skip
"""Its names of the bases, all but the angle."""
_EXPONENT = re.compile(r"(?<=[A-Za-z%)])(-?\d+)")
_POINT = re.compile(r"(?<=[A-Za-z)\d])\.(?=[A-Za-z(])")
_ALLOWED = re.compile(r"[\w*/(). +\-%]*", re.ASCII)
_TOO_MUCH = re.compile(r"\d{4}|\*\*\s*-?[\d.]+\s*\*\*|\*\*\s*\(")


@lru_cache(maxsize=1024)
def dimension_of_text(unit: str) -> Dimension | None:
    """Return the dimension of a unit's text; None for what says nothing or cannot be read.

    "1" and "%" are numbers; an empty text may mean anything, so it says nothing.
    """
    text = unit.strip()
    if not text or len(text) > LONGEST:
        return None
    if text in ("1", "%"):
        return NUMBER
    text = _spelled(text)
    if not _ALLOWED.fullmatch(text) or _TOO_MUCH.search(text) or AMBIGUOUS.search(text):
        return None
    registry = _registry()
    found, absolute = NUMBER, True
    try:
        for name, power in registry.Unit(text)._units.items():
            base = registry.parse_unit_name(name)[0][1]
            own = _dimension(registry, base)
            if own is None:
                return None
            absolute &= base not in ("degree_Celsius", "degree_Fahrenheit")
            found *= own.to(float(str(power)))
    except Exception:  # what is no unit may fail in any part of pint's parser
        return None
    return replace(found, absolute=absolute)


def _dimension(registry: pint.UnitRegistry[float], name: str) -> Dimension | None:
    """The dimension of one unit by pint's name; None for one that nobody measures in."""
    if name not in KNOWN:
        return None
    if name in ANGLES:
        return ANGLES[name]
    powers = {str(k): str(p) for k, p in registry.Unit(name).dimensionality.items()}
    return Dimension((*(float(powers.get(base, "0")) for base in PINT), 0.0))


def _spelled(unit: str) -> str:
    """A unit as pint writes it."""
    for sign, usual in SPELLINGS.items():
        unit = unit.replace(sign, usual)
    unit = _EXPONENT.sub(r"**\1", _POINT.sub("*", unit))
    return re.sub(r"[A-Za-z]+", lambda m: WORDS.get(m.group(), m.group()), unit)


@cache
def _registry() -> pint.UnitRegistry[float]:
    """All that pint knows."""
    import pint

    return pint.UnitRegistry()
