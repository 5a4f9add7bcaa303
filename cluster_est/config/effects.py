"""Effects that a config names: what is added to the model, and the parameters that come with it."""

from __future__ import annotations

from cluster_est.config.options import build_prior
from cluster_est.config.reader import Config, EffectSection
from cluster_est.config.sections.experiment import OutputSection
from cluster_est.errors import ConfigError
from cluster_est.problem.effects.declared import (
    DeclaredCoefficient,
    DeclaredEffect,
    MadeEffect,
    make_effect,
)
from cluster_est.problem.effects.sensors import shared_sensor
from cluster_est.problem.effects.table_values import UNBOUNDED, TableShape
from cluster_est.toml import dotted


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


def build_shared_sensors(config: Config) -> tuple[MadeEffect, ...]:
    """The effects of outputs whose scale or offset is shared, each with its coefficients.

    Raises
    ------
    ConfigError
        If one is shared in some experiments and not in others, or contradicts another key.
    """
    outputs: dict[str, OutputSection] = {}
    for experiment in config.experiments:
        for name, given in experiment.outputs.items():
            where = f"experiment {experiment.id!r}.{dotted('outputs', name)}"
            _check_shared(where, given, outputs.setdefault(name, given))
    return tuple(
        shared_sensor(
            name, scale=given.free_scale == "shared", offset=given.free_offset == "shared"
        )
        for name, given in outputs.items()
        if "shared" in (given.free_scale, given.free_offset)
    )


def _check_shared(where: str, given: OutputSection, first: OutputSection) -> None:
    """Refuse a shared scale or offset that not all experiments have, or that says nothing."""
    for key in ("free_scale", "free_offset"):
        value, elsewhere = getattr(given, key), getattr(first, key)
        if value != elsewhere and "shared" in (value, elsewhere):
            raise ConfigError(
                f'{where}.{key}: must be "shared" in all experiments with this output, or in none, '
                f"but is {value!r} here and {elsewhere!r} before; write it in experiment_defaults"
            )
        if value == "shared" and given.ordinal:
            raise ConfigError(
                f'{where}.{key}: must not be "shared" where the output is ordinal, for an order '
                "says nothing of sizes, but both are given; remove one of the two"
            )
    if given.free_offset == "shared" and given.free_scale is True:
        raise ConfigError(
            f'{where}.free_offset: must not be "shared" where free_scale is true, for what is '
            'shared would be scaled otherwise in each experiment; make free_scale "shared" too'
        )


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
