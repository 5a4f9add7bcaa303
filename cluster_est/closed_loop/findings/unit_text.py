"""The text of a unit, such as "W/(m2.K)", as powers of base units.

The units in which measurements come, their usual names, and the prefixes of the SI (Bureau
international des poids et mesures, The International System of Units, 9th ed. (2019),
doi:10.59161/AUEZ1291). What is not among them says nothing: nobody knows what "pu" measures.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

BASES = ("mass", "length", "time", "current", "temperature", "substance", "luminosity", "angle")
"""In the order of an FMU's definitions. An angle has a power of its own, or the speed of a shaft
could not be told from a rate."""
Powers = tuple[float, ...]
"""Of `BASES`."""


def powers(**given: float) -> Powers:
    """Return powers by the names of their bases."""
    return tuple(float(given.get(name, 0.0)) for name in BASES)


_UNITS = (
    ("m meter metre in inch inches ft foot feet mi mile", powers(length=1)),
    ("g gram t tonne metric_ton lb pound", powers(mass=1)),
    ("s sec second min minute h hr hrs hour d day", powers(time=1)),
    ("A amp ampere", powers(current=1)),
    ("K kelvin degK degC celsius degF fahrenheit degR rankine", powers(temperature=1)),
    ("mol mole", powers(substance=1)),
    ("cd candela lm lumen", powers(luminosity=1)),
    ("lx lux", powers(luminosity=1, length=-2)),
    ("rad radian deg degree arcdeg turn revolution cycle", powers(angle=1)),
    ("rpm revolutions_per_minute", powers(angle=1, time=-1)),
    ("Hz hertz", powers(time=-1)),
    ("N newton kgf kilogram_force lbf pound_force", powers(mass=1, length=1, time=-2)),
    ("Pa pascal bar atm atmosphere psi torr", powers(mass=1, length=-1, time=-2)),
    (
        "J joule Wh watt_hour watthour cal calorie eV electronvolt",
        powers(mass=1, length=2, time=-2),
    ),
    ("W watt metric_horsepower", powers(mass=1, length=2, time=-3)),
    ("V volt", powers(mass=1, length=2, time=-3, current=-1)),
    ("ohm", powers(mass=1, length=2, time=-3, current=-2)),
    ("S siemens mho", powers(mass=-1, length=-2, time=3, current=2)),
    ("farad", powers(mass=-1, length=-2, time=4, current=2)),
    ("H henry", powers(mass=1, length=2, time=-2, current=-2)),
    ("coulomb Ah ampere_hour", powers(current=1, time=1)),
    ("Wb weber", powers(mass=1, length=2, time=-2, current=-1)),
    ("T tesla", powers(mass=1, time=-2, current=-1)),
    ("l L liter litre", powers(length=3)),
    ("kn kt knot kph KPH mph MPH", powers(length=1, time=-1)),
    ("P poise", powers(mass=1, length=-1, time=-1)),
    ("St stokes", powers(length=2, time=-1)),
    ("% percent ppm dimensionless", powers()),
)
"""Names of units of one dimension. C and F are left out: for the SI coulomb and farad, but people
write Celsius and Fahrenheit so."""
_BY_NAME = {name: own for names, own in _UNITS for name in names.split()}
_RELATIVE = frozenset({"degC", "celsius", "degF", "fahrenheit"})
"""Those whose 0 is not that of the quantity."""
_PREFIXES = (
    *"qryzafpnumcdhkMGTPEZYRQ", "da",
    "quecto", "ronto", "yocto", "zepto", "atto", "femto", "pico", "nano", "micro", "milli", "centi",
    "deci", "deca", "deka", "hecto", "kilo", "mega", "giga", "tera", "peta", "exa", "zetta",
    "yotta", "ronna", "quetta",
)  # fmt: skip
_NO_UNIT = frozenset({"pH"})
"""What would be one of another quantity by its prefix."""
LONGEST_UNIT = 60
"""Signs of a unit's text; what is longer is none."""
LARGEST_POWER = 12.0
_SPELLINGS = {
    "°C": "degC", "℃": "degC", "°F": "degF", "°": "deg", "Ω": "ohm", "\u2126": "ohm",
    "\u00b5": "u", "\u03bc": "u", "·": "*", "\u22c5": "*", "²": "2", "³": "3", "⁻": "-", "¹": "1",
    "^": "**", "\u2212": "-",
}  # fmt: skip
_WORDS = {
    "Ohm": "ohm", "Nm": "N*m", "Ns": "N*s", "Cel": "degC", "RPM": "rpm", "rev": "revolution",
    "Celsius": "degC", "Kelvin": "kelvin", "per": "/",
}  # fmt: skip
_EXPONENT = re.compile(r"(?<=[A-Za-z%)])(-?\d+)")
_POINT = re.compile(r"(?<=[A-Za-z)\d])\.(?=[A-Za-z(])")
_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+(?:\.\d+)?)|(?P<name>[A-Za-z_]+|%)|(?P<sign>\*\*|[*/().-]))"
)


class TextUnit(NamedTuple):
    """What a text says: powers of `BASES`, and whether 0 of the unit is that of the quantity.

    It is not that of a temperature in degrees. In a product, a degree is a difference.
    """

    powers: Powers
    absolute: bool


class _NotAUnitError(ValueError):
    """What stands there is none."""


@lru_cache(maxsize=1024)
def read_unit(unit: str) -> TextUnit | None:
    """Return what "m/s2", "rad/s", "degC" or "W/(m2.K)" says; None of what says nothing.

    "1" and "%" are numbers; an empty text may mean anything, so it says nothing.
    """
    text = unit.strip()
    if not text or len(text) > LONGEST_UNIT:
        return None
    try:
        tokens = [*_tokens(_spelled(text))]
        found, rest = _product(tokens)
    except _NotAUnitError:
        return None
    absolute = len(tokens) > 1 or _known(tokens[0]) not in _RELATIVE
    return None if rest else TextUnit(found, absolute)


def _spelled(unit: str) -> str:
    """Return a unit with ** for powers and * for products, and usual names for others."""
    for sign, usual in _SPELLINGS.items():
        unit = unit.replace(sign, usual)
    unit = _EXPONENT.sub(r"**\1", _POINT.sub("*", unit))
    return re.sub(r"[A-Za-z]+", lambda m: _WORDS.get(m.group(), m.group()), unit)


def _tokens(text: str) -> Iterator[str]:
    place, text = 0, text.rstrip()
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise _NotAUnitError
        yield match.group().strip()
        place = match.end()


def _product(tokens: list[str]) -> tuple[Powers, list[str]]:
    """Return a product or quotient, from left to right, and the tokens behind it."""
    found, rest = _power(tokens)
    while rest and rest[0] != ")":
        sign = -1.0 if rest[0] == "/" else 1.0
        factor, rest = _power(rest[1:] if rest[0] in "*/." else rest)
        found = tuple(own + sign * other for own, other in zip(found, factor, strict=True))
    return found, rest


def _power(tokens: list[str]) -> tuple[Powers, list[str]]:
    """Return a unit or what stands in brackets, to its power, and the tokens behind it."""
    found, rest = _atom(tokens)
    if rest[:1] != ["**"]:
        return found, rest
    sign, rest = (-1.0, rest[2:]) if rest[1:2] == ["-"] else (1.0, rest[1:])
    if not rest or not rest[0][0].isdigit() or float(rest[0]) > LARGEST_POWER:
        raise _NotAUnitError
    return tuple(sign * float(rest[0]) * own for own in found), rest[1:]


def _atom(tokens: list[str]) -> tuple[Powers, list[str]]:
    if not tokens:
        raise _NotAUnitError
    first, rest = tokens[0], tokens[1:]
    if first == "(":
        found, rest = _product(rest)
        if not rest:
            raise _NotAUnitError
        return found, rest[1:]
    if first == "1":
        return powers(), rest
    name = _known(first)
    if name is None:
        raise _NotAUnitError
    return _BY_NAME[name], rest


def _known(word: str) -> str | None:
    """Return the unit that a word names, without a prefix and the s of a plural."""
    if word in _NO_UNIT:
        return None
    for text in (word, word.removesuffix("s") if len(word) >= len("bars") else word):
        if text in _BY_NAME:
            return text
        for prefix in _PREFIXES:
            rest = text.removeprefix(prefix)
            if rest != text and rest in _BY_NAME and rest not in _RELATIVE:
                return rest
    return None
