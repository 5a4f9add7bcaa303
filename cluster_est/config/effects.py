"""Effects that a config names: what is added to the model, and the parameters that come with it."""

from __future__ import annotations

import math

from cluster_est.config.reader import CoefficientSection, EffectSection
from cluster_est.errors import ConfigError
from cluster_est.problem.parameter import Parameter
from workers.fmu.description import nearest
from workers.messages import Effect


def build_effects(
    sections: tuple[EffectSection, ...],
) -> tuple[tuple[Effect, ...], tuple[Parameter, ...]]:
    """The effects of a config and their coefficients as parameters, in the same order.

    Raises
    ------
    ConfigError
        If an effect names both a form and an equation, or neither, or a coefficient that it lacks.
    EffectError
        If there is no such form or site.
    """
    pairs = [_build(section) for section in sections]
    effects = tuple(effect for effect, _ in pairs)
    return effects, tuple(p for _, parameters in pairs for p in parameters)


def _build(section: EffectSection) -> tuple[Effect, list[Parameter]]:
    from workers.effects.definition import coefficients  # SymPy takes long to import

    name = section.name or section.form
    where = f"effect {name!r}"
    if bool(section.form) == bool(section.equation):
        has = "both" if section.form else "neither"
        raise ConfigError(f"{where}: must have either form or equation but has {has}")
    if not name:
        raise ConfigError("effects: one with an equation must have a name; add name")
    own = tuple((n, c.neutral) for n, c in section.parameters.items()) if section.equation else ()
    effect = Effect(
        name, section.site, section.form, tuple(section.variables), section.equation, own
    )
    known = coefficients(effect, where)
    for given in section.parameters:
        if given not in [c.name for c in known]:
            raise ConfigError(
                f"{where}: parameters.{given}: {section.form} has no such coefficient"
                f"{nearest(given, [c.name for c in known])}"
            )
    parameters = []
    for coefficient in known:
        chosen = section.parameters.get(coefficient.name, CoefficientSection())
        start = chosen.start if chosen.start is not None else coefficient.neutral
        if start is None or not math.isfinite(start):
            raise ConfigError(
                f"{where}: parameters.{coefficient.name}.start is missing; {coefficient.name} of "
                f"{section.form or 'an own equation'} has no value to start from by itself"
            )
        lowest = 0.0 if coefficient.positive else -math.inf
        low, high = chosen.bounds if chosen.bounds is not None else (lowest, math.inf)
        label = f"{name}.{coefficient.name}"
        parameters.append(
            Parameter(
                label,
                start,
                low,
                high,
                chosen.scale,
                chosen.fixed,
                per=chosen.per,
                unit=chosen.unit,
            )
        )
    return effect, parameters
