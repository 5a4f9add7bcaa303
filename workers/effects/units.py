"""Units of coefficients, put together from those that the FMU names."""

from __future__ import annotations

import re
from collections.abc import Mapping

from workers.effects.definition import EffectDefinition
from workers.effects.site import split_variable
from workers.fmu.description import ModelDescription

UNKNOWN = "?"
_WORD = re.compile(r"(site|other|travel|second|v|w|s)(\^[\d.]+)?")


def coefficient_units(
    definition: EffectDefinition, description: ModelDescription
) -> tuple[str, ...]:
    """Return the unit of each coefficient of an effect, such as "N/(m/s)^2".

    A form says them in these words: `site` is what its equation gives (at the derivative of a state
    the state's unit over a second, elsewhere that of the signal, which `s` means too), `other` the
    same at the second derivative of a pair, `v` and `w` its variables, `travel` the integral of
    `v` over time, `second` a second. "?" stands for what the FMU does not name; coefficients of an
    equation of the user's own have no unit here.
    """
    units = _units(definition, description)
    return tuple(_fill(c.unit, units) for c in definition.form.coefficients)


def _units(definition: EffectDefinition, description: ModelDescription) -> dict[str, str]:
    def unit(name: str = "") -> str:
        known = description.variables.get(name)
        return (known.unit if known is not None else "") or UNKNOWN

    site = definition.site
    found = [unit(name) for name in site.targets]
    if site.at_rates:
        found = [_per_second(each) for each in found]
    units = {"site": found[0], "s": found[0], "other": found[-1], "second": "s"}
    texts = definition.effect.variables or (site.target,)
    for word, text in zip(("v", "w"), texts, strict=False):
        units[word] = unit(*split_variable(text, definition.uses)[:1])
    units["travel"] = _times_second(units["v"])
    return units


def _per_second(unit: str) -> str:
    """A unit over a second, so that "m/s" becomes "m/s^2"."""
    found = re.fullmatch(r"(.+)/s(?:\^?(\d))?", unit)
    return f"{found[1]}/s^{int(found[2] or 1) + 1}" if found else f"{unit}/s"


def _times_second(unit: str) -> str:
    return unit[:-2] if unit.endswith("/s") else f"{unit} s"


def _fill(template: str, units: Mapping[str, str]) -> str:
    """Put units in the place of a template's words; what is divided by is put in brackets."""
    over, _, under = template.partition(" / ")
    top = _WORD.sub(lambda m: _powered(m, units, alone=not m[2]), over)
    bottom = _WORD.sub(lambda m: _powered(m, units, alone=False), under)
    bottom = bottom.replace("(1 ", "(").replace(" 1)", ")")
    if bottom in ("", "1", "(1)"):
        return top
    if bottom in (top, f"({top})"):
        return "1"
    return _per_second(top) if bottom == "s" else f"{top}/{bottom}"


def _powered(found: re.Match[str], units: Mapping[str, str], *, alone: bool) -> str:
    """A unit to a power, in brackets where it is made of several."""
    unit, power = units[found[1]], found[2] or ""
    if unit == "1":
        return "1"
    return unit + power if alone or re.fullmatch(r"\w+|\?", unit) else f"({unit}){power}"
