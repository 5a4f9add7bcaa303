"""Units of the coefficients of effects, from the units of the FMU's variables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from workers.effects.site import split_variable
from workers.fmu.description import ModelDescription

if TYPE_CHECKING:  # SymPy takes long to import
    from workers.effects.definition import EffectDefinition

UNKNOWN_UNIT = "?"
_WORD = re.compile(r"(site|other|travel|second|v|w|s)(\^[\d.]+)?")


def coefficient_units(
    definition: EffectDefinition,
    description: ModelDescription,
    of_signals: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Return the unit of each coefficient of an effect, such as "N/(m/s)^2".

    A form's units consist of these words: `site` is the unit of the added term (at a derivative,
    the state's unit over a second; elsewhere, the unit of the signal, like `s`). `other` is the
    same for the second derivative of a pair. `v` and `w` are the units of the variables, `travel`
    that of the integral of `v` over time, and `second` is a second. `of_signals` are the units of
    measured signals that are not variables of the FMU. "?" replaces a unit that is not known.
    Coefficients of a user's own equation have no unit.
    """
    units = _units(definition, description, of_signals or {})
    return tuple(_fill(c.unit, units) for c in definition.form.coefficients)


def _units(
    definition: EffectDefinition, description: ModelDescription, of_signals: Mapping[str, str]
) -> dict[str, str]:
    def unit(name: str = "") -> str:
        known = description.variables.get(name)
        return (known.unit if known is not None else of_signals.get(name, "")) or UNKNOWN_UNIT

    site = definition.site
    found = [unit(name) for name in site.targets]
    if site.at_rates:
        found = [per_second(each) for each in found]
    units = {"site": found[0], "s": found[0], "other": found[-1], "second": "s"}
    texts = definition.effect.variables or (site.target,)
    for word, text in zip(("v", "w"), texts, strict=False):
        units[word] = unit(*split_variable(text, definition.uses)[:1])
    units["travel"] = _times_second(units["v"])
    return units


def per_second(unit: str) -> str:
    """Return a unit divided by a second: "m/s" becomes "m/s^2"."""
    found = re.fullmatch(r"(.+)/s(?:\^?(\d))?", unit)
    return f"{found[1]}/s^{int(found[2] or 1) + 1}" if found else f"{unit}/s"


def _times_second(unit: str) -> str:
    return unit[:-2] if unit.endswith("/s") else f"{unit} s"


def _fill(template: str, units: Mapping[str, str]) -> str:
    """Replace a template's words by units, with a composed denominator in brackets."""
    over, _, under = template.partition(" / ")
    top = _WORD.sub(lambda m: _powered(m, units, alone=not m[2]), over)
    bottom = _WORD.sub(lambda m: _powered(m, units, alone=False), under)
    bottom = bottom.replace("(1 ", "(").replace(" 1)", ")")
    if bottom in ("", "1", "(1)"):
        return top
    if bottom in (top, f"({top})"):
        return "1"
    if "?" not in bottom and top.startswith(f"{bottom}/"):  # for example "V/s" over "V"
        return f"1{top.removeprefix(bottom)}"
    shorter = _cancelled(top, bottom)
    if shorter:
        return shorter
    return per_second(top) if bottom == "s" else f"{top}/{bottom}"


_FACTOR = re.compile(r"(\((?:[^()]|\([^()]*\))*\)|[^\W\d_]+|1)(?:\^?(-?\d+(?:\.\d+)?))?")


def _cancelled(top: str, bottom: str) -> str:
    """Return a quotient of two units without their common factors.

    It is "" if a factor of the denominator is none of the numerator, because then the quotient as
    it is shows best what is divided. For example "1/rad" for "rad/s^2" over "(rad/s)^2".
    """
    over, under = _factors(top), _factors(bottom)
    if not over or not under or any(over.get(unit, 0.0) * p <= 0.0 for unit, p in under.items()):
        return ""
    powers = {unit: over.get(unit, 0.0) - under.get(unit, 0.0) for unit in over | under}
    parts = {
        way: [u if abs(p) == 1.0 else f"{u}^{abs(p):g}" for u, p in powers.items() if way * p > 0.0]
        for way in (1, -1)
    }
    above, below = (".".join(parts[way]) for way in (1, -1))
    if not below:
        return above or "1"
    return f"{above or 1}/({below})" if len(parts[-1]) > 1 else f"{above or 1}/{below}"


def _factors(unit: str) -> dict[str, float] | None:
    """Return the power of each factor of a unit such as "W/(m2.K)"; None for another notation."""
    found: dict[str, float] = {}
    way, rest = 1.0, unit
    while rest:
        match = _FACTOR.match(rest)
        if match is None:
            return None
        text, power = match[1], way * float(match[2] or 1.0)
        inner = _factors(text[1:-1]) if text.startswith("(") else {text: 1.0} if text != "1" else {}
        if inner is None:
            return None
        for factor, own in inner.items():
            found[factor] = found.get(factor, 0.0) + power * own
        rest = rest[match.end() :]
        if rest and rest[0] not in "./ ":
            return None
        way, rest = (-1.0 if rest[:1] == "/" else 1.0), rest[1:]
    return found


def _powered(found: re.Match[str], units: Mapping[str, str], *, alone: bool) -> str:
    """Return a unit to a power, with a composed unit in brackets."""
    unit, power = units[found[1]], found[2] or ""
    if unit == "1":
        return "1"
    return unit + power if alone or re.fullmatch(r"\w+|\?", unit) else f"({unit}){power}"
