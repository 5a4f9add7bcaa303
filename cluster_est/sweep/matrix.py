"""From a sweep file to the runs that it asks for, by name and override."""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cluster_est.config.reader import Config, read_config
from cluster_est.config.sections.sweep import NAME, SweepSections
from cluster_est.errors import ConfigError
from cluster_est.settings import error_messages
from cluster_est.toml import inline
from workers.fmu.description import nearest

ONLY, DROP = "only_experiments", "drop_experiments"
"""Override keys that no config has: which of its experiments a run keeps or leaves out, by id."""
LARGEST = 10_000
LONGEST_NAME = 150


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    Attributes
    ----------
    name
        Of its folder, made of the config's name and the values on each axis.
    config
        Path of its config.
    choices
        Which value it has on each axis; `config` is one of them.
    overrides
        (key, value) in the order in which they are put in; the last one wins.
    """

    name: str
    config: Path
    choices: dict[str, str] = field(default_factory=dict)
    overrides: tuple[tuple[str, Any], ...] = ()

    def read(self) -> Config:
        """Its config, resolved.

        Raises
        ------
        ConfigError
            If the config or an override is wrong.
        """
        subsets = [(key, ids) for key, ids in self.overrides if key in (ONLY, DROP)]
        texts = [f"{k}={inline(v)}" for k, v in self.overrides if k not in (ONLY, DROP)]
        config = read_config(self.config, texts)
        for key, ids in subsets:
            config = _subset(config, key, ids)
        return config


def read_sweep(path: Path) -> list[SweepRun]:
    """Read and check a sweep file.

    Raises
    ------
    ConfigError
        With one line for each problem.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: must be TOML in UTF-8 but is not: {error}; mend it") from None
    try:
        sweep = SweepSections.model_validate(raw)
    except ValidationError as error:
        raise ConfigError("\n".join(error_messages(error, str(path), raw, SweepSections))) from None
    _refuse(path, [*_wrong_names(sweep), *_wrong_overrides(sweep), *_wrong_skips(sweep)])
    count = len(sweep.configs) * math.prod(len(axis.values) for axis in sweep.axes)
    if count > LARGEST:
        _refuse(path, [f"axes: must make at most {LARGEST} runs but make {count}; remove some"])
    runs = [*_matrix(sweep, path.parent), *_singles(sweep, path.parent)]
    _refuse(path, [*_wrong_runs(runs)])
    return runs


def _refuse(path: Path, problems: list[str]) -> None:
    if problems:
        raise ConfigError("\n".join(f"{path}: {problem}" for problem in problems))


def _matrix(sweep: SweepSections, base: Path) -> Iterator[SweepRun]:
    """Every combination; later axes change faster."""
    for config, *names in itertools.product(sweep.configs, *(a.values for a in sweep.axes)):
        picked = list(zip(sweep.axes, names, strict=True))
        choices = {"config": config} | {axis.name: name for axis, name in picked}
        if any(all(choices[axis] in left for axis, left in each.items()) for each in sweep.skip):
            continue
        overrides = [*sweep.overrides.items()]
        for axis, name in picked:
            value = axis.values[name]
            overrides += [(axis.key, value)] if axis.key else value.items()
        # A value without its key says nothing: seed_0, but least_squares.
        parts = [f"{axis.name}_{name}" if axis.key else name for axis, name in picked]
        path = base / sweep.configs[config]
        yield SweepRun("-".join([config, *parts]), path, choices, tuple(overrides))


def _singles(sweep: SweepSections, base: Path) -> Iterator[SweepRun]:
    for each in sweep.runs:
        config = each.config or next(iter(sweep.configs))
        overrides = (*sweep.overrides.items(), *each.overrides.items())
        yield SweepRun(each.name, base / sweep.configs[config], {"config": config}, overrides)


def _wrong_names(sweep: SweepSections) -> Iterator[str]:
    named = [(f"configs.{name}", name) for name in sweep.configs]
    for axis in sweep.axes:
        named.append((f"axes.{axis.name}", axis.name))
        named += [(f"axes.{axis.name}.values.{name}", name) for name in axis.values]
    named += [(f"runs.{run.name}", run.name) for run in sweep.runs]
    for where, name in named:
        if not NAME.fullmatch(name):
            yield (
                f"{where}: the name must consist of letters, digits and . _ + - and begin and end "
                f"with a letter or digit but is {name!r}; give another one"
            )
    axes = ["config", *(axis.name for axis in sweep.axes)]
    for name in sorted({name for name in axes if axes.count(name) > 1}):
        yield f"axes.{name}: the name must be given once but is there again; rename one"
    for run in sweep.runs:
        if run.config and run.config not in sweep.configs:
            hint = nearest(run.config, sweep.configs)
            yield f"runs.{run.name}.config: there is no {run.config!r}{hint}"
        if not run.config and len(sweep.configs) > 1:
            yield f"runs.{run.name}.config is missing; add it, because there are several configs"


def _wrong_overrides(sweep: SweepSections) -> Iterator[str]:
    tables: list[tuple[str, Any]] = [("overrides", sweep.overrides)]
    tables += [(f"runs.{run.name}.overrides", run.overrides) for run in sweep.runs]
    for axis in sweep.axes:
        for name, value in axis.values.items():
            table = {axis.key: value} if axis.key else value
            tables.append((f"axes.{axis.name}.values.{name}", table))
    for where, table in tables:
        if not isinstance(table, dict):
            yield f"{where}: must be a table of overrides, because its axis has no key; add a key"
            continue
        for key, value in table.items():
            yield from _wrong_override(where, key, value)


def _wrong_override(where: str, key: str, value: Any) -> Iterator[str]:
    if key in (ONLY, DROP):
        if not (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
            yield f"{where}.{key}: must be a list of experiments' ids but is {value!r}"
    elif isinstance(value, dict) and "." not in key:
        inner = next(iter(value), "KEY")
        yield f'{where}.{key}: keys with dots must stand in quotes; write "{key}.{inner}" = ...'
    elif not key.strip() or "=" in key:
        yield f"{where}: a key must be like method.seed but is {key!r}; mend it"


def _wrong_skips(sweep: SweepSections) -> Iterator[str]:
    known = {"config": [*sweep.configs]} | {axis.name: [*axis.values] for axis in sweep.axes}
    for i, skip in enumerate(sweep.skip):
        if not skip:
            yield f"skip[{i}]: must name an axis but is empty; remove it"
        for axis, names in skip.items():
            if axis not in known:
                yield f"skip[{i}].{axis}: there is no such axis{nearest(axis, known)}"
                continue
            for name in names:
                if name not in known[axis]:
                    yield f"skip[{i}].{axis}: there is no {name!r}{nearest(name, known[axis])}"


def _wrong_runs(runs: list[SweepRun]) -> Iterator[str]:
    if not runs:
        yield "skip: must leave some run but leaves none; remove one of its entries"
    seen: dict[str, str] = {}
    for run in runs:
        if len(run.name) > LONGEST_NAME:
            yield f"{run.name}: the name of a run must have at most {LONGEST_NAME} characters"
        if run.name in ("sweep.json", "summary.parquet"):
            yield f"runs.{run.name}: the name is taken by a file of the sweep; give another one"
        other = seen.get(run.name.lower())  # some file systems ignore case
        if other is not None:
            yield f"{run.name}: two runs must not have one name, but {other} has it; rename one"
        seen[run.name.lower()] = run.name


def _subset(config: Config, key: str, ids: list[str]) -> Config:
    known = [experiment.id for experiment in config.experiments]
    for name in ids:
        if name not in known:
            raise ConfigError(f"{key}: there is no experiment {name!r}{nearest(name, known)}")
    kept = [e for e in config.experiments if (e.id in ids) is (key == ONLY)]
    if not kept:
        raise ConfigError(f"{key}: must leave some experiment but leaves none; change the list")
    return config.model_copy(update={"experiments": kept})
