"""Maps as parameters: a table of values over points, smooth and monotone if that is known.

`cluster_est.problem.effects.table_values` says what smoothness is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cluster_est.config.reader import Config, ConstraintSection, ParameterSection
from cluster_est.config.sections.maps import MapSection
from cluster_est.errors import ConfigError
from cluster_est.problem.effects.table_values import TableShape, ValueTable, check_table_name
from cluster_est.toml import dotted


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
