"""Effects that a config names: what is added to the model, and the parameters that come with it.

Maps become parameters too: a table of values over points, smooth and monotone if that is known;
`cluster_est.problem.free_curves` says what smoothness is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cluster_est.config.options import build_prior
from cluster_est.config.reader import Config, ConstraintSection, EffectSection, ParameterSection
from cluster_est.config.sections.experiment import OutputSection
from cluster_est.config.sections.sections import MapSection
from cluster_est.errors import ConfigError
from cluster_est.problem.declared_effects import (
    DeclaredCoefficient,
    DeclaredEffect,
    MadeEffect,
    make_effect,
)
from cluster_est.problem.free_curves import UNBOUNDED, TableShape, ValueTable, check_table_name
from cluster_est.problem.sensors import shared_sensor
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


def with_maps(config: Config) -> Config:
    """Return the config with its maps written out as parameters and constraints.

    Raises
    ------
    ConfigError
        If a map contradicts itself, or takes a name that a parameter has.
    """
    if not config.maps:
        return config
    parameters, constraints = dict(config.parameters), list(config.constraints)
    for name, section in config.maps.items():
        table = _table(name, section)
        for key, parameter in _parameters(section, table).items():
            if key in parameters:
                raise ConfigError(
                    f"{dotted('maps', name)}: its value {key} must have a name of its own but "
                    "there is a "
                    "parameter of that name; rename one of the two"
                )
            parameters[key] = parameter
        if not section.fixed:
            constraints += [ConstraintSection(expression=text) for text in table.order()]
    return config.model_copy(
        update={"parameters": parameters, "constraints": constraints, "maps": {}}
    )


def _table(name: str, section: MapSection) -> ValueTable:
    """A map as a table of values, checked."""
    where, count = dotted("maps", name), len(section.points)
    check_table_name(name, where, "NAME_1, NAME_2, ...")
    if len(section.variables) != count:
        raise ConfigError(
            f"{where}.variables: must be as many as the points, {count}, but are "
            f"{len(section.variables)}; add or remove some"
        )
    if isinstance(section.start, list) and len(section.start) != count:
        raise ConfigError(
            f"{where}.start: must be a number, or one for each of the {count} points, but are "
            f"{len(section.start)}"
        )
    starts = section.start if isinstance(section.start, list) else [section.start] * count
    table = ValueTable(
        where,
        f"{name}_",
        tuple(f"{name}_{i}" for i in range(1, count + 1)),
        tuple(section.points),
        tuple(starts),
        TableShape(section.slope_change, section.monotone, section.bounds),
    )
    table.check()
    return table


def _parameters(section: MapSection, table: ValueTable) -> Mapping[str, ParameterSection]:
    """The parameters of a map, by their names in the config."""
    names = [name for name in table.values if name is not None]
    of_values = dict(zip(names, section.variables, strict=True))
    if section.slope_change is None or section.fixed:
        starts = zip(names, table.starts, strict=True)
        return {
            name: ParameterSection(
                start=start,
                bounds=section.bounds,
                fixed=section.fixed,
                variable=of_values[name],
                unit=section.unit,
            )
            for name, start in starts
        }
    found = {}
    for each in table.unknowns():
        known: dict[str, Any] = {"name": "normal", "mean": 0.0, "sd": each.sd}
        found[each.name] = ParameterSection(
            start=each.start,
            bounds=(each.lower, each.upper),
            auxiliary=True,
            prior={} if each.sd is None else known,
        )
    for name, text in table.expressions():
        found[name] = ParameterSection(expression=text, variable=of_values[name], unit=section.unit)
    return found
