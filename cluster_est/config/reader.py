"""Reading and checking of config files.

The keys are declared in `sections.py`; the message about an unknown key names the nearest key. The
contents of `value_files` (SSP parameter sets, or tables) are inserted into the raw tree before the
complete tree is checked. So the config saved by a run contains all numbers itself. SSP 1.0, System
Structure and Parameterization (Modelica Association, 2019), section 5.
"""

from __future__ import annotations

import copy
import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cluster_est.config.config_text import override, read_toml, unfilled
from cluster_est.config.experiment_keys import (
    DEFAULTS,
    SIGMAS,
    ExperimentDefaultsSection,
    ExperimentSection,
    unused_defaults,
    with_defaults,
)
from cluster_est.config.sections import Config
from cluster_est.config.several_experiments import with_every_experiment
from cluster_est.errors import ConfigError
from cluster_est.executors import EXECUTORS
from cluster_est.methods import METHOD_ALIASES, SEARCH_METHODS
from cluster_est.problem.costs import COST_ALIASES, COSTS
from cluster_est.problem.tables.measured import (
    missing_time,
    relative_without_sigma,
    sigma_without_output,
)
from cluster_est.settings import checked
from cluster_est.toml import dotted
from cluster_est.whole_files import is_sealed
from workers.fmu.description import nearest
from workers.messages import Value
from workers.messages.checks import as_path, as_tuple, shown, told_apart

VALUE_FILES = "value_files"


def read_config(path: str | Path, overrides: Sequence[str] | None = None) -> Config:
    """Read and check a config file.

    Parameters
    ----------
    path
        The TOML file.
    overrides
        "key=value" with dots in the key, as on the command line.

    Raises
    ------
    ConfigError
        If there is no such file, it is not TOML, or a key is unknown or has a wrong value.
    """
    path = as_path(path, "config", ConfigError)
    changes = as_tuple(() if overrides is None else overrides, str, "overrides", ConfigError)
    text, raw = read_toml(path, "there is no config file")
    late = [change for change in changes if not _changed(raw, change)]
    open_ = list(unfilled(raw, text, str(path)))
    if open_:
        raise ConfigError("\n".join(open_))
    base = config_folder(path)
    raw = with_every_experiment(raw, base)
    for change in late:
        override(raw, change)
    tree, units = with_values_of_files(raw, base)
    return parse_config(tree, str(path)).with_units_of_files(units)


def config_folder(path: Path) -> Path:
    """Return the folder to which the paths in a config are relative.

    It is the folder of the config. For the config in a run folder, it is the folder of the run's
    original config, which run.json records.
    """
    known = _recorded(path, "config_folder")
    return known if known is not None and known.is_dir() else path.parent


def original_config(path: Path) -> Path | None:
    """Return the config itself; for the config in a run folder, the run's original config."""
    return _recorded(path, "config_file") if _is_of_run(path) else path


def _is_of_run(path: Path) -> bool:
    try:
        return path.name == "config.toml" and is_sealed(path.read_bytes())
    except OSError:
        return False


def _recorded(path: Path, fact: str) -> Path | None:
    """Return a path from the run.json beside a config; None if the config is not that of a run."""
    try:
        facts = json.loads((path.parent / "run.json").read_bytes()) if _is_of_run(path) else {}
        return Path(facts[fact]) if facts.get(fact) else None
    except (OSError, ValueError, AttributeError, TypeError):
        return None


def _changed(raw: dict[str, Any], change: str) -> bool:
    """Override a key that exists in the file; return whether it exists."""
    before = copy.deepcopy(raw)
    try:
        override(raw, change)
    except ConfigError:
        if raw == before and change.lstrip().startswith("experiments."):
            return False  # the key may belong to an experiment from a file pattern
        raise
    return True


def parse_config(raw: dict[str, Any], where: str) -> Config:
    """Check a config tree in memory; `where` is the start of each message.

    Raises
    ------
    ConfigError
        If there are problems. The message has one line for each.
    """
    if raw.get(VALUE_FILES):
        raise ConfigError(
            f"{where}.{VALUE_FILES}: is only possible in a config file; give the values themselves"
        )
    defaults = raw.get(DEFAULTS, {})
    if DEFAULTS in raw:
        checked(_OnlyDefaults, raw, where, root=Config)
        raw = with_defaults(raw)
    config = checked(Config, raw, where)
    problems = [*_unknown_names(config), *unused_defaults(defaults, config.experiments)]
    problems += _missing_starts(config)
    constrained = bool(config.constraints or config.cost.function)
    for experiment in config.experiments:
        problems += _contradictions(experiment, constrained=constrained)
    if problems:
        raise ConfigError("\n".join(f"{where}: {problem}" for problem in problems))
    return config


class _OnlyDefaults(BaseModel):
    """A config in which only the defaults of the experiments are checked."""

    experiment_defaults: ExperimentDefaultsSection


def _unknown_names(config: Config) -> Iterator[str]:
    choices: list[tuple[str, str, list[str], list[str]]] = [
        ("cost.name", config.cost.name, list(COSTS), list(COST_ALIASES)),
        ("method.name", config.method.name, list(SEARCH_METHODS), list(METHOD_ALIASES)),
        ("executor.name", config.executor.name, list(EXECUTORS), []),
    ]
    for key, name, known, aliases in choices:
        if name not in (*known, *aliases):
            yield f"{key}: there is no {name!r}{nearest(name, known)}"


def _missing_starts(config: Config) -> Iterator[str]:
    for name, parameter in config.parameters.items():
        key = dotted("parameters", name)
        if parameter.start is None and not parameter.expression:
            yield (
                f"{key}.start is missing; add it (start value of the estimation, in the FMU's unit)"
            )
        elif parameter.start is not None and parameter.expression:
            yield (
                f"{key}.start: must not be used with expression, which gives the value; remove one "
                "of the two"
            )


def _wrong_source(where: str, experiment: ExperimentSection, *, constrained: bool) -> Iterator[str]:
    """Yield problems of data, times and measured signals, which depend on each other."""
    timed = experiment.outputs or experiment.inputs or experiment.signals
    given = [key for key in ("time", "sample_time") if getattr(experiment, key) is not None]
    if not experiment.outputs and experiment.curve is None and not constrained:
        yield f"{where}.outputs is missing; add it (FMU output = column), or add the key curve"
    elif experiment.data is None:
        if timed or experiment.curve is not None or given:
            yield f"{where}.data is missing; add it (path of the table, such as a csv file)"
    elif timed and len(given) != 1:
        yield missing_time(where, experiment.time, experiment.sample_time)
    elif isinstance(experiment.data, list) and len(experiment.data) > 1:
        for key in ("sample_time", "rows", "split_by"):
            if getattr(experiment, key) is not None:
                yield (
                    f"{where}.{key}: must not be used if data names several files, which need a "
                    "column with the time; remove it"
                )
    if not timed and (experiment.start is None or experiment.stop is None):
        yield (
            f"{where}: an experiment without measured times must have start and stop (in seconds), "
            "but one of them is missing; add both"
        )


def _wrong_sigmas(where: str, experiment: ExperimentSection) -> Iterator[str]:
    for key in SIGMAS:
        for name in getattr(experiment, key):
            if name not in experiment.outputs:
                yield sigma_without_output(f"{where}.{key}", name, experiment.outputs)
    for name in experiment.left_out:
        if name not in experiment.outputs:
            yield sigma_without_output(f"{where}.left_out", name, experiment.outputs)
    for name in experiment.relative_sigma:
        if name in experiment.outputs and name not in experiment.sigma:
            yield relative_without_sigma(where, name)


def _contradictions(experiment: ExperimentSection, *, constrained: bool) -> Iterator[str]:
    """Yield contradictions in an experiment's section, before any file is read."""
    where = f"experiments[{experiment.id!r}]"
    yield from _wrong_source(where, experiment, constrained=constrained)
    yield from _wrong_sigmas(where, experiment)
    if (experiment.split_by is None) is not (experiment.split_value is None):
        yield (
            f"{where}: must have both split_by and split_value, or neither, if it is not read from "
            "a config file, but has only one of them; add the other"
        )
    for name in experiment.outputs:
        if name in experiment.inputs:
            yield (
                f"{where}.outputs.{name}: must not be an input of the same experiment, because the "
                "FMU does not compute its inputs; remove one of the two"
            )
    start, stop = experiment.start, experiment.stop
    if start is not None and stop is not None and not start < stop:
        begin, end = told_apart(start, stop)
        yield (
            f"{where}.start: must be before stop, which is {end} s, but is {begin} s; change one "
            "of them"
        )
    for key in ("windows", "test_windows"):
        for i, (first, last) in enumerate(getattr(experiment, key)):
            if not first <= last:
                yield (
                    f"{where}.{key}[{i}]: must be [from, to] with from before to, but is "
                    f"[{first:g}, {last:g}]; swap them"
                )
    if experiment.rows is not None and not experiment.rows[0] < experiment.rows[1]:
        yield (
            f"{where}.rows: must be [from, to] with from below to, but is {list(experiment.rows)}; "
            "swap them, or remove the key to use all rows"
        )


@dataclass(frozen=True)
class GivenValue:
    """A value of a file; `unit` is "" if none is given."""

    name: str
    value: Value
    unit: str
    file: str


def with_values_of_files(
    raw: Mapping[str, Any], base: Path
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a config's tree with the values of the files that it names, and their units.

    A value of a parameter of the config, of a variable of a map, or of an effect's coefficient
    ("EFFECT.COEFFICIENT"), becomes its start. Any other value becomes a known value of all
    experiments, unless the config has one itself. Later files take precedence.

    Parameters
    ----------
    raw
        The tree, as read from TOML; it is not changed.
    base
        Folder to which paths of files are relative.

    Raises
    ------
    ConfigError
        If a file is missing, is not a list of values, or has some values of a map without a start.
    """
    tree = {key: copy.deepcopy(value) for key, value in raw.items() if key != VALUE_FILES}
    given = {each.name: each for path in _paths(raw, base) for each in read_values(path)}
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
    """Set the starts of the maps that have these variables; return the variables' names."""
    found: set[str] = set()
    for key, own in _tables(maps.items()):
        variables = own.get("variables")
        names = variables if isinstance(variables, list) else []
        there = [name for name in names if name in given]
        start = own.get("start")
        before = start if isinstance(start, list) else [start] * len(names)
        if there and len(before) == len(names):  # otherwise the check of the config refuses it
            own["start"] = _starts_of_map(key, dict(zip(names, before, strict=True)), given)
            found |= set(there)
    return found


def _starts_of_map(
    key: str, before: Mapping[str, Any], given: Mapping[str, GivenValue]
) -> list[Any]:
    """Return the starts of a map, replaced by the values of the files."""
    starts = {n: _start(given[n]) if n in given else start for n, start in before.items()}
    missing = [name for name, start in starts.items() if start is None]
    if missing:
        raise ConfigError(
            f"{dotted('maps', key)}.start is missing, and no file of values has "
            f"{', '.join(missing)}; add start, or give the values of all variables of the map in "
            f"{VALUE_FILES}"
        )
    return list(starts.values())


def _tables(sections: Iterable[tuple[Any, Any]]) -> list[tuple[Any, dict[str, Any]]]:
    """Return the sections that are tables; the check of the config refuses others."""
    return [(name, each) for name, each in sections if isinstance(each, dict)]


def _inner(section: dict[str, Any], key: str) -> dict[str, Any]:
    """Return the table under a key, created if missing; a dummy if the key has another type."""
    found = section.setdefault(key, {})
    return found if isinstance(found, dict) else {}


def _start(given: GivenValue) -> float:
    if isinstance(given.value, bool | str):
        raise ConfigError(
            f"{VALUE_FILES}: {given.file}: {given.name} is estimated, so its value must be a "
            f"number, but is {shown(given.value)}; correct it (the decimal separator is a point)"
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


def read_values(path: Path) -> list[GivenValue]:
    """Read the values of a file.

    Raises
    ------
    ConfigError
        If it is neither a parameter set nor a table of values.
    """
    readers = {".ssv": _parameter_set, ".csv": _csv}
    if path.suffix.lower() not in readers:
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} must end in .ssv or .csv; rename it or convert it"
        )
    try:
        return list(readers[path.suffix.lower()](path))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} cannot be read ({error}); check the path and its "
            "permissions"
        ) from error


def _parameter_set(path: Path) -> Iterator[GivenValue]:
    from fmpy.ssp.ssd import read_ssv  # its lxml is slow to import

    try:
        found = read_ssv(str(path)).parameters
    except Exception as error:  # fmpy and lxml raise many kinds of exceptions
        why = " ".join(str(error).split())
        raise ConfigError(
            f"{VALUE_FILES}: {path.name} must be a parameter set of SSP 1.0, but is not ({why}); "
            "export it again"
        ) from error
    for each in found:
        value = str(each.value) if each.type == "String" else _value(str(each.value))
        if each.type == "Boolean":
            value = each.value in ("true", "1")
        yield GivenValue(str(each.name), value, each.unit or "", path.name)


def _csv(path: Path) -> Iterator[GivenValue]:
    """Yield the values of a table with columns name, value and optionally unit."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        head = file.readline()
        file.seek(0)
        rows = csv.DictReader(file, delimiter=";" if ";" in head else ",", skipinitialspace=True)
        missing = [name for name in ("name", "value") if name not in (rows.fieldnames or ())]
        if missing:
            raise ConfigError(
                f"{VALUE_FILES}: {path.name} must have the columns name and value, but has "
                f"{', '.join(map(str, rows.fieldnames or ())) or 'none'}; name the columns in the "
                "first row"
            )
        for row in rows:
            name, value = (row["name"] or "").strip(), (row["value"] or "").strip()
            if not name:
                continue
            unit = (row.get("unit") or "").strip()
            yield GivenValue(name, _value(value), unit, path.name)


def _value(text: str) -> Value:
    """Return a number, a Boolean, or otherwise the text."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
