"""`value_files`: values of parameters from SSP parameter sets, or from tables.

They are put into the raw tree of a config before it is checked as a whole, so that a run's own
config has every number itself. SSP 1.0, System Structure and Parameterization (Modelica
Association, 2019), section 5.
"""

from __future__ import annotations

import copy
import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster_est.errors import ConfigError
from cluster_est.toml import dotted
from workers.messages import Value
from workers.messages.checks import shown

VALUE_FILES = "value_files"


@dataclass(frozen=True)
class GivenValue:
    """A value of a file; `unit` is "" where none is given."""

    name: str
    value: Value
    unit: str
    file: str


def with_values_of_files(
    raw: Mapping[str, Any], base: Path
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a config's tree with the values of the files that it names, and their units.

    A value of a parameter of the config, of a variable of a map, or of an effect's coefficient
    ("EFFECT.COEFFICIENT"), becomes its start. Any other becomes a known value of all experiments,
    unless the config has one itself. Of two files the later one counts.

    Parameters
    ----------
    raw
        As read from TOML; it is not changed.
    base
        The folder that paths of files start from.

    Raises
    ------
    ConfigError
        If a file is missing, is no list of values, or has some values of a map without a start.
    """
    tree = {key: copy.deepcopy(value) for key, value in raw.items() if key != VALUE_FILES}
    given = {each.name: each for path in _paths(raw, base) for each in _read(path)}
    if not given:
        return tree, {}
    parameters, listed = _inner(tree, "parameters"), tree.get("effects")
    effects = listed if isinstance(listed, list) else []
    by_target = {own.get("variable") or name: own for name, own in _tables(parameters.items())}
    by_effect = {own.get("name") or own.get("form"): own for _, own in _tables(enumerate(effects))}
    maps = tree.get("maps")
    of_maps = _into_maps(maps if isinstance(maps, dict) else {}, given)
    for name, each in given.items():
        effect, _, coefficient = name.rpartition(".")
        if name in by_target:
            by_target[name]["start"] = _start(each)
        elif name in of_maps:
            continue
        elif effect in by_effect:
            _inner(_inner(by_effect[effect], "parameters"), coefficient)["start"] = _start(each)
        else:
            _inner(tree, "values").setdefault(name, each.value)
    return tree, {name: each.unit for name, each in given.items() if each.unit}


def _into_maps(maps: Mapping[str, Any], given: Mapping[str, GivenValue]) -> set[str]:
    """Put values into the starts of the maps that have these variables; return their names."""
    found: set[str] = set()
    for key, own in _tables(maps.items()):
        variables = own.get("variables")
        names = variables if isinstance(variables, list) else []
        there = [name for name in names if name in given]
        start = own.get("start")
        before = start if isinstance(start, list) else [start] * len(names)
        if there and len(before) == len(names):  # else it is refused when the config is checked
            own["start"] = _starts_of_map(key, dict(zip(names, before, strict=True)), given)
            found |= set(there)
    return found


def _starts_of_map(
    key: str, before: Mapping[str, Any], given: Mapping[str, GivenValue]
) -> list[Any]:
    """The starts of a map, by its variables, with what the files have in their place."""
    starts = {n: _start(given[n]) if n in given else start for n, start in before.items()}
    missing = [name for name, start in starts.items() if start is None]
    if missing:
        raise ConfigError(
            f"{dotted('maps', key)}.start: must be there where the files of values have not all of "
            "its "
            f"variables, but is not, and {', '.join(missing)} stand in none; add start"
        )
    return list(starts.values())


def _tables(sections: Iterable[tuple[Any, Any]]) -> list[tuple[Any, dict[str, Any]]]:
    """Those that are tables; what is none is refused when the config is checked."""
    return [(name, each) for name, each in sections if isinstance(each, dict)]


def _inner(section: dict[str, Any], key: str) -> dict[str, Any]:
    """The table under a key, which is made; one of no use where something else stands there."""
    found = section.setdefault(key, {})
    return found if isinstance(found, dict) else {}


def _start(given: GivenValue) -> float:
    if isinstance(given.value, bool | str):
        raise ConfigError(
            f"{VALUE_FILES}: {given.file}: {given.name} must be a number, because it is estimated, "
            f"but is {shown(given.value)}; correct it (decimals stand behind a point)"
        )
    return float(given.value)


def _paths(raw: Mapping[str, Any], base: Path) -> list[Path]:
    names = raw.get(VALUE_FILES, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(
            f'{VALUE_FILES}: must be a list of files, like ["values.ssv"], but is {shown(names)}'
        )
    paths = [base / name for name in names]
    for path in paths:
        if not path.is_file():
            raise ConfigError(f"{VALUE_FILES}: there is no file {path}; check the name")
    return paths


def _read(path: Path) -> list[GivenValue]:
    """The values of a file.

    Raises
    ------
    ConfigError
        If it is neither a parameter set nor a table of values.
    """
    readers = {".ssv": _parameter_set, ".csv": _csv}
    if path.suffix.lower() not in readers:
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} must end in .ssv or .csv; rename or convert it"
        )
    try:
        return list(readers[path.suffix.lower()](path))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} cannot be read ({error}); check it"
        ) from error


def _parameter_set(path: Path) -> Iterator[GivenValue]:
    from fmpy.ssp.ssd import read_ssv  # lxml is slow to import

    try:
        found = read_ssv(str(path)).parameters
    except Exception as error:  # of whatever kind fmpy and lxml raise
        why = " ".join(str(error).split())
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} must be a parameter set of SSP 1.0 but is not ({why})"
        ) from error
    for each in found:
        value = str(each.value) if each.type == "String" else _value(str(each.value))
        if each.type == "Boolean":
            value = each.value in ("true", "1")
        yield GivenValue(str(each.name), value, each.unit or "", path.name)


def _csv(path: Path) -> Iterator[GivenValue]:
    """Columns name and value, and unit where there is one; others are left alone."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        head = file.readline()
        file.seek(0)
        rows = csv.DictReader(file, delimiter=";" if ";" in head else ",", skipinitialspace=True)
        missing = [name for name in ("name", "value") if name not in (rows.fieldnames or ())]
        if missing:
            raise ConfigError(
                f"{VALUE_FILES}: {path.name} must have the columns name and value but has "
                f"{', '.join(map(str, rows.fieldnames or ())) or 'none'}; name them in row 1"
            )
        for row in rows:
            name, value = (row["name"] or "").strip(), (row["value"] or "").strip()
            if not name:
                continue
            unit = (row.get("unit") or "").strip()
            yield GivenValue(name, _value(value), unit, path.name)


def _value(text: str) -> Value:
    """A number, true or false, or else a text."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
