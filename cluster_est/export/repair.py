"""The model of a run with its estimates and effects, gathered from its folder for an export."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cluster_est.config.build import build_problem
from cluster_est.config.reader import EffectSection, parse_config
from cluster_est.errors import RunFolderError
from cluster_est.export.parameter_reader import ParameterReader
from cluster_est.export.repaired_model import RepairedModel, ReportedError
from cluster_est.problem.problem import Problem
from cluster_est.results.tables.row_types import Estimate
from cluster_est.run_folder.reading import (
    check_has_estimates,
    read_config_text,
    read_facts,
    read_run_table,
)
from cluster_est.run_folder.replay import config_base
from workers.fmu.description import nearest
from workers.messages import Experiment

Row = Mapping[str, Any]
FITTED = "the original with its parameters fitted"
"""What the errors of a closed loop before its repair are those of."""


def gather(
    run_folder: Path, config: Path | None, experiment: str | None, *, allow_code: bool
) -> RepairedModel:
    """Read what a run was made from and what it has found.

    Parameters
    ----------
    run_folder
        Of a finished fit or closed loop.
    config
        The config that it was made from, if that has moved.
    experiment
        Whose values are taken, where parameters have one for each; None for shared values alone.
    allow_code
        Whether Python functions that the config names may run.

    Raises
    ------
    ClusterEstError
        If the run is not finished, its files are gone, or the FMU is another now.
    """
    facts = read_facts(run_folder)
    table = run_folder / "parameters.parquet"
    if not table.is_file():
        check_has_estimates(run_folder)
        raise RunFolderError(
            f"{run_folder}: must be the folder of a finished run but is {facts.get('status')!r}; "
            "finish it with --resume"
        )
    if not facts.get("config_hash"):
        raise RunFolderError(
            f"{run_folder}: was saved from Python and has no config to be exported from; use "
            "result.export(...) there"
        )
    problem = _problem(run_folder, facts, config, allow_code=allow_code)
    _check_same(run_folder, facts, problem)
    chosen = _experiment(problem, experiment)
    rows = {row["label"]: row for row in read_run_table(table)}
    description = problem.describe()
    repair = ParameterReader(problem, description, rows, chosen).repair(run_folder.resolve().name)
    path = run_folder / "errors.parquet"
    errors = read_run_table(path) if path.is_file() else []
    shapes = run_folder / "shapes.parquet"
    ranges = _ranges(read_run_table(shapes)) if shapes.is_file() else {}
    repair = dataclasses.replace(repair, ranges=ranges)
    return _with_errors(repair, errors, fitted=facts.get("verdict") is not None)


def repaired(
    problem: Problem,
    estimates: Sequence[Estimate],
    experiment: str | None,
    run: str = "result",
    errors: Sequence[Row] = (),
    *,
    fitted: bool = False,
) -> RepairedModel:
    """The same from a result in memory.

    Parameters
    ----------
    problem
        With all effects.
    estimates
        What was found for it.
    experiment
        As of `gather`.
    run
        The name that takes the place of the folder's.
    errors
        Rows of the table of errors.
    fitted
        Whether those before are of a fit: of a closed loop they are.
    """
    rows = {each.label: dataclasses.asdict(each) for each in estimates}
    chosen = _experiment(problem, experiment)
    repair = ParameterReader(problem, problem.describe(), rows, chosen).repair(run)
    return _with_errors(repair, errors, fitted=fitted)


def _ranges(shapes: Sequence[Row]) -> dict[str, str]:
    """Return for each effect the range that its variable had in the data."""
    found = {}
    for row in shapes:
        if row["x"] and row["variable"]:
            unit = row["variable_unit"]
            unit = f" {unit}" if unit not in ("", "1") else ""
            low, high = min(row["x"]), max(row["x"])
            found[row["effect"]] = f"{row['variable']} from {low:.4g} to {high:.4g}{unit}"
    return found


def _with_errors(repair: RepairedModel, errors: Sequence[Row], *, fitted: bool) -> RepairedModel:
    found = tuple(ReportedError.of(row) for row in errors)
    without = FITTED if fitted else repair.without
    return dataclasses.replace(repair, errors=found, without=without)


def _problem(run_folder: Path, facts: Row, config: Path | None, *, allow_code: bool) -> Problem:
    """The problem of the last fit: a closed loop has added effects to that of its config."""
    path, text = run_folder / "config.toml", read_config_text(run_folder)
    try:
        raw = tomllib.loads(text)
    except ValueError as error:
        raise RunFolderError(f"{path}: cannot be read ({error}); it belongs to the run") from error
    resolved = parse_config(raw, str(path))
    found = [tomllib.loads(effect["config"])["effects"][0] for effect in facts.get("effects", [])]
    names = {section.name or section.form for section in resolved.effects}
    added = [EffectSection(**each) for each in found if each["name"] not in names]
    resolved = resolved.model_copy(update={"effects": [*resolved.effects, *added]})
    return build_problem(resolved, config_base(run_folder, config), allow_code=allow_code)


def _check_same(run_folder: Path, facts: Row, problem: Problem) -> None:
    then, now = facts["fmu"]["sha256"], problem.model.archive_hash
    if then != now:
        raise RunFolderError(
            f"{run_folder}: {problem.model.name} must be the FMU that the run was made with but "
            "has changed since; put that one back, or fit again"
        )


def _experiment(problem: Problem, name: str | None) -> Experiment | None:
    if name is None:
        return None
    known = {experiment.id: experiment for experiment in problem.experiments}
    if name not in known:
        raise RunFolderError(
            f"experiment: must be an experiment of the run but is {name!r}{nearest(name, known)}"
        )
    return known[name]
