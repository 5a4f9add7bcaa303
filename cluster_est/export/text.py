"""Effects as text for a modeller: site, equation, values with intervals."""

from __future__ import annotations

from cluster_est.closed_loop.candidates.equation import equation_text
from cluster_est.export.repaired_model import EstimatedValue, RepairedModel
from workers.effects.definition import EffectDefinition


def describe_repair(repair: RepairedModel) -> str:
    """All that a run has found, as plain text."""
    lines = ["Parameters", *(_line(found) for found in repair.parameters)]
    lines = lines if repair.parameters else []
    return "\n".join([*lines, *([""] if lines else []), describe_effects(repair)])


def describe_effects(repair: RepairedModel) -> str:
    """The effects: site, equation and coefficients of each."""
    if not repair.effects:
        return "No effects were added.\n"
    lines = ["Effects"]
    for effect, values in zip(repair.effects, repair.coefficients, strict=True):
        lines += [f"  {effect.effect.name} ({effect.form.name}) at {effect.site}"]
        lines += [f"    {effect_equation(effect)}"]
        prefix = f"{effect.effect.name}."
        lines += [f"  {_line(value, prefix)}" for value in values]
        if effect.effect.name in repair.ranges:
            lines += [f"    estimated over {repair.ranges[effect.effect.name]}; beyond, a guess"]
    return "\n".join(lines) + "\n"


def effect_equation(effect: EffectDefinition) -> str:
    """The equation as a person reads it."""
    if not effect.effect.equation:
        return equation_text(effect.effect, effect.form, effect.site)
    own = effect.effect
    if effect.site.other:
        first, second = effect.site.targets
        return f"der({first}) += {own.equation}, der({second}) += {own.reaction}"
    sign = "+=" if effect.site.at_rates else "->"
    left = str(effect.site) if effect.site.at_rates else effect.site.target
    return f"{left} {sign} {own.equation}"


def _line(found: EstimatedValue, prefix: str = "") -> str:
    unit = f" {found.unit}" if found.unit not in ("", "1") else ""
    interval = f"  ({found.interval})" if found.interval else ""
    return f"  {found.name.removeprefix(prefix)} = {found.value:.6g}{unit}{interval}"
