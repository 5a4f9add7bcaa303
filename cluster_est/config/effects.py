"""Effects that a config names: what is added to the model, and the parameters that come with it."""

from __future__ import annotations

from cluster_est.config.options import build_prior
from cluster_est.config.reader import EffectSection
from cluster_est.problem.effects import (
    DeclaredCoefficient,
    DeclaredEffect,
    MadeEffect,
    make_effect,
)
from cluster_est.problem.table_values import UNBOUNDED, TableShape


def build_effects(sections: tuple[EffectSection, ...]) -> tuple[MadeEffect, ...]:
    """The effects of a config, each with its coefficients as parameters.

    Raises
    ------
    ConfigError
        If an effect names both a form and an equation, or neither, or a coefficient that it lacks.
    EffectError
        If there is no such form or site.
    """
    return tuple(make_effect(_declared(section)) for section in sections)


def _declared(section: EffectSection) -> DeclaredEffect:
    return DeclaredEffect(
        section.name,
        section.site,
        section.form,
        section.equation,
        tuple(section.variables),
        {
            name: DeclaredCoefficient(
                start=chosen.start,
                bounds=chosen.bounds,
                scale=chosen.scale,
                fixed=chosen.fixed,
                neutral=chosen.neutral,
                per=chosen.per,
                unit=chosen.unit,
                prior=build_prior(
                    chosen.prior,
                    f"effects.{section.name or section.form}.parameters.{name}.prior",
                ),
            )
            for name, chosen in section.parameters.items()
        },
        section.reaction,
        TableShape(section.slope_change, section.monotone, section.bounds or UNBOUNDED),
    )
