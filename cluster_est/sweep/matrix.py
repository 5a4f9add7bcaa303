"""Reads a sweep file, makes its runs, and determines their status."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from cluster_est.config.config_text import read_toml
from cluster_est.config.reader import read_config
from cluster_est.config.sections import Config
from cluster_est.errors import ConfigError, RunFolderError
from cluster_est.run_folder.resume import is_whole
from cluster_est.run_folder.run_files import (
    SWEEP_HISTORY_FILE,
    SWEEP_STATE_FILE,
    SWEEP_SUMMARY_FILE,
    RunStatus,
    read_config_text,
    read_facts,
    read_run_table,
    write_run_columns,
)
from cluster_est.run_folder.run_folder import BEGUN
from cluster_est.run_folder.run_identity import RunIdentity, RunKind, versions
from cluster_est.settings import ConfigSection, checked
from cluster_est.studies.configured import STUDIES
from cluster_est.sweep.history import GO_ON, with_all_columns
from cluster_est.toml import inline
from cluster_est.whole_files import write_whole
from workers.fmu.description import nearest
from workers.messages import content_hash

RUN_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._+-]*[A-Za-z0-9])?")
"""Pattern for names of runs and their parts, which are valid on every file system."""


def value_name(value: Any) -> str:
    """Return the text of a plain value for the name of a run; "" for other values."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | int | float):
        return re.sub(r"[^A-Za-z0-9._+-]", "_", str(value)).strip("._")
    return ""


def _configs(value: Any) -> Any:
    """Convert a list of paths to a table with the files' names."""
    if not isinstance(value, list):
        return value
    if not all(isinstance(path, str) for path in value):
        raise PydanticCustomError("paths", "must be a list of paths in quotes")
    found = {PurePath(path).stem: path for path in value}
    if len(found) < len(value):
        raise PydanticCustomError(
            "paths", 'must have files with different names, or be a table: { NAME = "path" }'
        )
    return found


def _values(value: Any) -> Any:
    """Convert a list of plain values to a table with the values as names."""
    if not isinstance(value, list):
        return value
    named = {value_name(each): each for each in value}
    if "" in named or len(named) < len(value):
        raise PydanticCustomError(
            "values", "must be a list of different plain values, or a table: { NAME = value }"
        )
    return named


def _names(value: Any) -> Any:
    """Return the names of one value or of several values."""
    return [value_name(each) for each in (value if isinstance(value, list) else [value])]


class AxisSection(ConfigSection):
    """One axis of a sweep: values of a key, or sets of overrides."""

    name: str = Field(
        min_length=1, description="name of the axis, which is also a column of the summary"
    )
    key: str = Field(
        "", description='key of the config to which the values belong, such as "method.seed"'
    )
    values: Annotated[dict[str, Any], BeforeValidator(_values)] = Field(
        min_length=1,
        description="with key: a list of values, or { NAME = value }; without key: tables of "
        'overrides, { NAME = { "KEY" = value } }',
    )


class SingleRunSection(ConfigSection):
    """A single run in addition to the combinations."""

    name: str = Field(min_length=1, description="name of the run and of its folder")
    config: str = Field("", description="name of the config; required if there are several configs")
    overrides: dict[str, Any] = Field(default_factory=dict, description='"KEY" = value')


STUDY_NAMES = tuple(kind.value for kind in STUDIES)


class SweepSections(ConfigSection):
    """A whole sweep file."""

    configs: Annotated[dict[str, str], BeforeValidator(_configs)] = Field(
        min_length=1,
        description="paths of configs, relative to the folder of the sweep, or a table: { NAME = "
        '"path" }',
    )
    study: Literal[STUDY_NAMES] = Field(  # type: ignore[valid-type]
        "fit", description="study that is run for each config"
    )
    overrides: dict[str, Any] = Field(
        default_factory=dict, description='"KEY" = value: overrides for every run'
    )
    axes: list[AxisSection] = Field(
        default_factory=list,
        description="axes of the sweep; every combination of their values is a run",
    )
    skip: list[dict[str, Annotated[list[str], BeforeValidator(_names)]]] = Field(
        default_factory=list,
        description="combinations to leave out: AXIS = value, or a list of values",
    )
    runs: list[SingleRunSection] = Field(
        default_factory=list, description="single runs in addition to the combinations"
    )


ONLY, DROP = "only_experiments", "drop_experiments"
"""Additional override keys: ids of the experiments that a run keeps or leaves out."""
MOST_RUNS = 10_000
LONGEST_RUN_NAME = 150


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    Attributes
    ----------
    name
        Name of the run and of its folder, made of the config's name and the values on each axis.
    config
        Path of the config.
    choices
        Name of the value on each axis; `config` is also an axis.
    overrides
        Pairs (key, value); later values replace earlier ones.
    study
        The kind of study.
    """

    name: str
    config: Path
    choices: dict[str, str] = field(default_factory=dict)
    overrides: tuple[tuple[str, Any], ...] = ()
    study: RunKind = RunKind.FIT

    def read(self) -> Config:
        """Return the resolved config.

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
        If the file has errors; the message has one line for each error.
    """
    _, raw = read_toml(path, "there is no sweep file")
    sweep = checked(SweepSections, raw, str(path))
    _refuse(path, [*_wrong_names(sweep), *_wrong_overrides(sweep), *_wrong_skips(sweep)])
    count = len(sweep.configs) * math.prod(len(axis.values) for axis in sweep.axes)
    if count > MOST_RUNS:
        _refuse(
            path,
            [f"axes: must make at most {MOST_RUNS} runs, but make {count}; remove some values"],
        )
    runs = [*_matrix(sweep, path.parent), *_singles(sweep, path.parent)]
    _refuse(path, [*_wrong_runs(runs)])
    return runs


def _refuse(path: Path, problems: list[str]) -> None:
    if problems:
        raise ConfigError("\n".join(f"{path}: {problem}" for problem in problems))


def _matrix(sweep: SweepSections, base: Path) -> Iterator[SweepRun]:
    """Yield the run of every combination; later axes change faster."""
    for config, *names in itertools.product(sweep.configs, *(a.values for a in sweep.axes)):
        picked = list(zip(sweep.axes, names, strict=True))
        choices = {"config": config} | {axis.name: name for axis, name in picked}
        if any(all(choices[axis] in left for axis, left in each.items()) for each in sweep.skip):
            continue
        overrides = [*sweep.overrides.items()]
        for axis, name in picked:
            value = axis.values[name]
            overrides += [(axis.key, value)] if axis.key else value.items()
        # with a key, the axis is part of the name: "seed_0", but "least_squares"
        parts = [f"{axis.name}_{name}" if axis.key else name for axis, name in picked]
        name, path = "-".join([config, *parts]), base / sweep.configs[config]
        yield SweepRun(name, path, choices, tuple(overrides), RunKind(sweep.study))


def _singles(sweep: SweepSections, base: Path) -> Iterator[SweepRun]:
    for each in sweep.runs:
        config = each.config or next(iter(sweep.configs))
        overrides = (*sweep.overrides.items(), *each.overrides.items())
        path, choices = base / sweep.configs[config], {"config": config}
        yield SweepRun(each.name, path, choices, overrides, RunKind(sweep.study))


def _wrong_names(sweep: SweepSections) -> Iterator[str]:
    named = [(f"configs.{name}", name) for name in sweep.configs]
    for axis in sweep.axes:
        named.append((f"axes.{axis.name}", axis.name))
        named += [(f"axes.{axis.name}.values.{name}", name) for name in axis.values]
    named += [(f"runs.{run.name}", run.name) for run in sweep.runs]
    for where, name in named:
        if not RUN_NAME.fullmatch(name):
            yield (
                f"{where}: the name must consist of letters, digits and . _ + -, and begin and end "
                f"with a letter or digit, but is {name!r}; choose another name"
            )
    axes = ["config", *(axis.name for axis in sweep.axes)]
    for name in sorted({name for name in axes if axes.count(name) > 1}):
        yield (
            f"axes.{name}: the name must be used only once, but is used twice; rename one of the "
            "axes"
        )
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
            yield f"{where}.{key}: must be a list of ids of experiments, but is {value!r}"
    elif isinstance(value, dict) and "." not in key:
        inner = next(iter(value), "KEY")
        yield f'{where}.{key}: keys with dots must be in quotes; write "{key}.{inner}" = ...'
    elif not key.strip() or "=" in key:
        yield f"{where}: a key must be written like method.seed, but is {key!r}; correct it"


def _wrong_skips(sweep: SweepSections) -> Iterator[str]:
    known = {"config": [*sweep.configs]} | {axis.name: [*axis.values] for axis in sweep.axes}
    for i, skip in enumerate(sweep.skip):
        if not skip:
            yield f"skip[{i}]: must name an axis, but is empty; remove it"
        for axis, names in skip.items():
            if axis not in known:
                yield f"skip[{i}].{axis}: there is no axis of that name{nearest(axis, known)}"
                continue
            for name in names:
                if name not in known[axis]:
                    yield (
                        f"skip[{i}].{axis}: the axis has no value "
                        f"{name!r}{nearest(name, known[axis])}"
                    )


def _wrong_runs(runs: list[SweepRun]) -> Iterator[str]:
    if not runs:
        yield "skip: must leave at least one run, but leaves none; remove one of its entries"
    seen: dict[str, str] = {}
    for run in runs:
        if len(run.name) > LONGEST_RUN_NAME:
            yield (
                f"{run.name}: the name of a run must have at most {LONGEST_RUN_NAME} characters, "
                f"but has {len(run.name)}; shorten it"
            )
        if run.name in (SWEEP_STATE_FILE, SWEEP_SUMMARY_FILE, SWEEP_HISTORY_FILE):
            yield f"runs.{run.name}: a file of the sweep has this name; choose another name"
        other = seen.get(run.name.lower())  # some file systems ignore case
        if other is not None:
            yield (
                f"{run.name}: two runs must not have the same name, but {other} has it too; rename "
                "one of them"
            )
        seen[run.name.lower()] = run.name


def _subset(config: Config, key: str, ids: list[str]) -> Config:
    known = [experiment.id for experiment in config.experiments]
    for name in ids:
        if name not in known:
            raise ConfigError(f"{key}: there is no experiment {name!r}{nearest(name, known)}")
    kept = [e for e in config.experiments if (e.id in ids) is (key == ONLY)]
    if not kept:
        raise ConfigError(
            f"{key}: must leave at least one experiment, but leaves none; change the list"
        )
    return config.model_copy(update={"experiments": kept})


SUCCESS = RunStatus.DONE
FAILED_STATES = (RunStatus.FAILED, RunStatus.NOT_CONVERGED)
NOT_RUN = "not run"


@dataclass(frozen=True)
class PlannedRun:
    """A run that was checked.

    Attributes
    ----------
    run
        The run.
    fingerprint
        Hash of all inputs of the result: config, data, FMU and versions.
    budget
        Budget of the run. It does not matter for a run that has reached a solution.
    pool
        Key of the workers; runs with the same key share their workers.
    cluster
        (executor, workers, address) for an executor on a cluster, which all such runs share; None
        for other executors.
    """

    run: SweepRun
    fingerprint: str
    budget: dict[str, Any]
    pool: str
    cluster: tuple[str, int | None, str | None] | None


def fingerprint(identity: RunIdentity) -> str:
    """Return the hash of the inputs of a run."""
    problem = identity.problem
    return _hash(
        identity.config_hash,
        problem.model.archive_hash,
        {e.id: e.key for e in problem.experiments},
        versions(),
    )


def status(folder: Path, planned: PlannedRun) -> str:
    """Return the status of a run; "not run" if it must be executed (again).

    Raises
    ------
    RunFolderError
        If the folder contains anything but a run.
    """
    if not (folder / "run.json").is_file():
        _check_strange(folder)
        return NOT_RUN
    try:
        facts = read_facts(folder)
        known = _hash(
            facts["config_hash"], facts["fmu"]["sha256"], facts["experiments"], facts["versions"]
        )
    except (RunFolderError, KeyError, TypeError):
        return NOT_RUN
    found = str(facts["status"])
    if (
        known != planned.fingerprint
        or found not in (SUCCESS, *FAILED_STATES)
        or not is_whole(folder)
    ):
        return NOT_RUN
    if found in FAILED_STATES and _budget(folder) != planned.budget:
        return NOT_RUN
    return found


def clear_torn(folder: Path) -> None:
    """Remove files that a killed process left before run.json was written."""
    if folder.is_dir() and not (folder / "run.json").is_file():
        _check_strange(folder)
        shutil.rmtree(folder)


def check_folder(out: Path) -> None:
    """Refuse a folder that is not new, empty, or the folder of a sweep.

    Raises
    ------
    RunFolderError
        If it is a file, or contains other files but no sweep.
    """
    if out.exists() and not out.is_dir():
        raise RunFolderError(f"{out}: must be a folder, but is a file; choose another --out")
    if not out.is_dir() or (out / SWEEP_STATE_FILE).is_file():
        return
    if any(not each.name.startswith(".sweep.") for each in out.iterdir()):
        raise RunFolderError(
            f"{out}: must be a new or empty folder, or the folder of a sweep, but holds other "
            "files; choose another folder"
        )


def write_state(out: Path, sweep: Path, states: dict[str, str], *, running: str = "") -> None:
    """Write sweep.json with the status of each run, for users and monitors."""
    facts = {"format": "1", "sweep": str(sweep), "running": running, "runs": states}
    text = json.dumps(facts, indent=2) + "\n"
    write_whole(out / SWEEP_STATE_FILE, text.encode(), GO_ON)


def summary_rows(
    out: Path, plan: Sequence[PlannedRun], states: dict[str, str]
) -> list[dict[str, Any]]:
    """Return one row for each run, in order: choices, outcome and shared estimates."""
    axes = dict.fromkeys(axis for planned in plan for axis in planned.run.choices)
    return with_all_columns(
        [_row(out, planned.run, states[planned.run.name], [*axes]) for planned in plan]
    )


def write_summary(out: Path, rows: list[dict[str, Any]]) -> None:
    """Write summary.parquet atomically."""
    write_run_columns(out / SWEEP_SUMMARY_FILE, pa.Table.from_pylist(rows), GO_ON)


def _row(out: Path, run: SweepRun, state: str, axes: list[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"run": run.name}
    row |= {axis: run.choices.get(axis, "") for axis in axes}
    row |= {"status": state, "message": "", "doubts": ""}
    if state == NOT_RUN:
        return row
    facts = read_facts(out / run.name)
    errors = facts.get("rmse_over_sigma") or {}
    row |= {"message": facts.get("message") or "", "doubts": "; ".join(facts.get("doubts") or ())}
    if "sensitivity" in facts:
        row["together"] = ", ".join(facts["sensitivity"]["together"])
    else:
        row |= {key: facts.get(key) for key in ("cost_before", "cost")}
        row |= {f"rmse_{role}": errors.get(role) for role in ("train", "test")}
    if "effects" in facts:
        row["verdict"] = facts["verdict"]
        row["effects"] = ", ".join(each["name"] for each in facts["effects"])
    counts = ("iterations", "evaluations", "simulations", "failures", "seconds", "seed", "started")
    row |= {key: facts.get(key) for key in counts}
    path = out / run.name / "parameters.parquet"
    for each in read_run_table(path) if path.is_file() else []:
        if each["scope"] == "shared" and each["estimated_on"] == "train":
            row[f"parameter {each['label']}"] = each["value"]
    return row


def _check_strange(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise RunFolderError(f"{folder}: must be the folder of a run, but is a file; move it away")
    strange = {each.name for each in folder.iterdir()} - BEGUN if folder.is_dir() else set()
    if strange:
        raise RunFolderError(
            f"{folder}: must be the folder of a run, but holds other files, such as "
            f"{min(strange)!r}; move them away"
        )


def _budget(folder: Path) -> dict[str, Any]:
    try:
        found = tomllib.loads(read_config_text(folder))
    except (RunFolderError, ValueError):
        return {}
    budget: dict[str, Any] = found.get("budget", {})
    return budget


def _hash(*parts: Any) -> str:
    return content_hash([json.dumps(parts, sort_keys=True)])
