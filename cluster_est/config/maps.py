"""Maps as parameters: a table of values over points, smooth and monotone if that is known.

Without smoothness each value is a parameter of its own. With it, the unknowns are the value and the
slope at the first point and the change of slope at each point between, of which a prior says that
it is normal about 0 with a variance that grows with the distance of the points,

    b_i ~ N(0, s^2 (h_(i-1) + h_i) / 2),

the integrated Wiener process that smoothing splines stand for, as far as the points show it (G.
Wahba, J. R. Stat. Soc. B 40 (1978) 364-372, doi:10.1111/j.2517-6161.1978.tb01050.x). So more points
make a map no rougher. The values follow from the unknowns by expressions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise

from cluster_est.config.reader import Config, ConstraintSection, ParameterSection
from cluster_est.config.sections.maps import MapSection
from cluster_est.errors import ConfigError

FARTHEST = 8.0
"""Standard deviations up to which a change of slope is searched."""


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
        where = f"maps.{name}"
        _check(name, section)
        for key, parameter in _parameters(name, section).items():
            if key in parameters:
                raise ConfigError(
                    f"{where}: its value {key} must have a name of its own but there is a "
                    "parameter of that name; rename one of the two"
                )
            parameters[key] = parameter
        constraints += _constraints(name, section)
    return config.model_copy(
        update={"parameters": parameters, "constraints": constraints, "maps": {}}
    )


def _check(name: str, section: MapSection) -> None:
    where = f"maps.{name}"
    count = len(section.points)
    if not name.isidentifier():
        raise ConfigError(
            f"{where}: must have a name of letters, digits and _, because its values are called "
            f"NAME_1, NAME_2, ..., but is {name!r}; rename it"
        )
    if len(section.variables) != count:
        raise ConfigError(
            f"{where}.variables: must be as many as the points, {count}, but are "
            f"{len(section.variables)}; add or remove some"
        )
    if not all(a < b for a, b in pairwise(section.points)):
        raise ConfigError(f"{where}.points: must increase but do not; sort them with their values")
    if isinstance(section.start, list) and len(section.start) != count:
        raise ConfigError(
            f"{where}.start: must be a number, or one for each of the {count} points, but are "
            f"{len(section.start)}"
        )
    low, high = section.bounds
    if not low < high:
        raise ConfigError(
            f"{where}.bounds: must be [lower, upper] but are {[low, high]}; swap them"
        )
    for start in _starts(section):
        if not low <= start <= high:
            raise ConfigError(
                f"{where}.start: must lie within the bounds {[low, high]} but has {start:g}; move "
                "one of the two"
            )
    if section.slope_change is not None and not (math.isfinite(low) and math.isfinite(high)):
        raise ConfigError(
            f"{where}.bounds: must be finite where slope_change says how smooth the map is, but "
            f"are {[low, high]}; say between which values it lies"
        )


def _starts(section: MapSection) -> list[float]:
    if isinstance(section.start, list):
        return section.start
    return [section.start] * len(section.points)


def _parameters(name: str, section: MapSection) -> Mapping[str, ParameterSection]:
    """The parameters of a map, by their names in the config."""
    starts, found = _starts(section), {}
    if section.slope_change is None:
        for i, (variable, start) in enumerate(zip(section.variables, starts, strict=True), 1):
            found[f"{name}_{i}"] = ParameterSection(
                start=start, bounds=section.bounds, variable=variable, unit=section.unit
            )
        return found
    found |= dict(_unknowns(name, section, starts))
    for i, expression in enumerate(_expressions(name, section), 1):
        found[f"{name}_{i}"] = ParameterSection(
            expression=expression,
            variable=section.variables[i - 1],
            unit=section.unit,
        )
    return found


def _unknowns(
    name: str, section: MapSection, starts: list[float]
) -> Iterator[tuple[str, ParameterSection]]:
    """First value, first slope, and changes of slope."""
    assert section.slope_change is not None
    low, high = section.bounds
    widths = [b - a for a, b in pairwise(section.points)]
    slopes = [(b - a) / h for (a, b), h in zip(pairwise(starts), widths, strict=True)]
    steepest = (high - low) / min(widths)
    yield f"{name}_level", ParameterSection(start=starts[0], bounds=section.bounds, auxiliary=True)
    yield (
        f"{name}_slope",
        ParameterSection(start=slopes[0], bounds=(-steepest, steepest), auxiliary=True),
    )
    for i, ((before, after), pair) in enumerate(
        zip(pairwise(slopes), pairwise(widths), strict=True), 2
    ):
        sd = section.slope_change * math.sqrt(0.5 * sum(pair))
        most = FARTHEST * sd
        yield (
            f"{name}_bend_{i}",
            ParameterSection(
                start=min(max(after - before, -most), most),
                bounds=(-most, most),
                auxiliary=True,
                prior={"name": "normal", "mean": 0.0, "sd": sd},
            ),
        )


def _expressions(name: str, section: MapSection) -> Iterator[str]:
    """Each value, from the unknowns and the values before it."""
    widths = [b - a for a, b in pairwise(section.points)]
    yield f"{name}_level"
    yield f"{name}_1 + {widths[0]!r} * {name}_slope"
    for i, (before, width) in enumerate(pairwise(widths), 2):
        slope = f"({name}_{i} - {name}_{i - 1}) / {before!r}"
        yield f"{name}_{i} + {width!r} * ({slope} + {name}_bend_{i})"


def _constraints(name: str, section: MapSection) -> Iterator[ConstraintSection]:
    """The order of the values."""
    if section.monotone:
        sign = "<=" if section.monotone == "increasing" else ">="
        for i in range(1, len(section.points)):
            yield ConstraintSection(expression=f"{name}_{i} {sign} {name}_{i + 1}")
