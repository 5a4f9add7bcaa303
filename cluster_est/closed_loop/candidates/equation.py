"""An effect's equation as a person reads it, with the FMU's names in it."""

from __future__ import annotations

import re

from workers.effects.forms import EffectForm
from workers.effects.site import EffectSite, own_variable, parts_of
from workers.messages import Effect


def equation_text(effect: Effect, form: EffectForm, site: EffectSite) -> str:
    """Return what an effect adds to its site, or makes of the signal there.

    "der(v) += -k * tanh(v / width)", "F -> F + k * F^2", "u -> delay(u, tau)". A coefficient
    or a state of its own that has the name of a variable in the equation carries the effect's name
    before it.
    """
    names = dict(zip(("v", "w"), effect.variables, strict=False))
    if form.variables and not effect.variables:
        names["v"] = own_variable(site)
    at_rates = site.kind in ("derivative", "pair")
    if not at_rates:
        names["s"] = site.target
    coefficients = [c.name for c in form.coefficients]
    taken = {part for name in names.values() for part in parts_of(name)}
    own_names = [*coefficients, *(z.name for z in form.states)]
    names |= {name: f"{effect.name}.{name}" for name in own_names if name in taken}

    def named(text: str) -> str:
        return re.sub(r"[A-Za-z_]\w*(?!\w*\()", lambda m: _bracketed(names, m.group()), text)

    if form.memory:
        return f"{site.target} -> {form.memory}({site.target}, {coefficients[0]})"
    if form.free:
        argument = effect.variables[-1] if effect.variables else names.get("v", site.target)
        table = f"table of {argument} from low to high: "
        values = [c.name for c in form.coefficients if c.neutral is not None]
        table += ", ".join(values if len(values) < 9 else [*values[:2], "...", values[-1]])
        if site.kind == "pair":
            first, second = site.targets
            return f"der({first}) += {table}; der({second}) -= {names.get('back', 'back')} times it"
        if site.kind == "parameter":
            return f"{site.target} -> {site.target} * (1 + {table})"
        if form.variables > 1:
            return f"{site} += {named('-tanh(v / width)')} * ({table})"
        return f"{site} += {table}" if at_rates else f"{site.target} -> {site.target} + {table}"
    text = named(form.equation)
    if site.kind == "pair":
        first, second = site.targets
        return f"der({first}) += {text}, der({second}) += {named(form.reaction)}"
    own = "".join(f", {named(z.name)}' = {named(z.derivative)}" for z in form.states)
    return f"{site} += {text}{own}" if at_rates else f"{site.target} -> {text}{own}"


def _bracketed(names: dict[str, str], word: str) -> str:
    name = names.get(word, word)
    return f"({name})" if " " in name else name
