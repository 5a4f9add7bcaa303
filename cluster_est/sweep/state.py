"""The state of a sweep, read from its run folders, and its summary table."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.folder import BEGUN
from cluster_est.run_folder.judgement import doubts_of
from cluster_est.run_folder.reading import (
    read_config_text,
    read_facts,
    read_run_table,
    write_run_columns,
)
from cluster_est.run_folder.resume import is_whole
from cluster_est.run_folder.run_identity import RunIdentity, versions
from cluster_est.run_folder.run_status import RunStatus
from cluster_est.sweep.matrix import SweepRun
from cluster_est.whole_files import write_whole
from workers.messages import content_hash

STATE, SUMMARY = "sweep.json", "summary.parquet"
SUCCESS = RunStatus.DONE
FAILED = (RunStatus.FAILED, RunStatus.NOT_CONVERGED)
NOT_RUN = "not run"
GO_ON = "see that there is room and that it may be written, and give the same command again"


@dataclass(frozen=True)
class PlannedRun:
    """A run that was checked.

    Attributes
    ----------
    run
        Its name, config and overrides.
    fingerprint
        Hash of all that its result depends on: config, data, FMU and versions.
    budget
        Its budget; a run that reached a solution does not depend on it.
    pool
        Runs with the same one share their workers.
    cluster
        (executor, workers, address) if its executor runs on a cluster, which all such runs share.
    """

    run: SweepRun
    fingerprint: str
    budget: dict[str, Any]
    pool: str
    cluster: tuple[str, int | None, str | None] | None


def fingerprint(identity: RunIdentity) -> str:
    """Return the hash of what a run will depend on."""
    problem = identity.problem
    return _hash(
        identity.config_hash,
        problem.model.archive_hash,
        {e.id: e.key for e in problem.experiments},
        versions(),
    )


def status(folder: Path, planned: PlannedRun) -> str:
    """Return the status of a run, "not run" if it must be run (again).

    Raises
    ------
    RunFolderError
        If the folder holds something else than a run.
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
    if known != planned.fingerprint or found not in (SUCCESS, *FAILED) or not is_whole(folder):
        return NOT_RUN
    if found in FAILED and _budget(folder) != planned.budget:
        return NOT_RUN
    return found


def clear_torn(folder: Path) -> None:
    """Remove what a killed process left before there was a run.json."""
    if folder.is_dir() and not (folder / "run.json").is_file():
        _check_strange(folder)
        shutil.rmtree(folder)


def check_folder(out: Path) -> None:
    """Refuse a folder that is no sweep's.

    Raises
    ------
    RunFolderError
        If it is a file, or holds something but no sweep.
    """
    if out.exists() and not out.is_dir():
        raise RunFolderError(f"{out}: must be a folder but is a file; choose another --out")
    if not out.is_dir() or (out / STATE).is_file():
        return
    if any(not each.name.startswith(".sweep.") for each in out.iterdir()):
        raise RunFolderError(
            f"{out}: must be new, empty or a sweep's own but holds other files; choose another"
        )


def write_state(out: Path, sweep: Path, states: dict[str, str], *, running: str = "") -> None:
    """Write sweep.json: where each run stands, for people and monitors."""
    facts = {"format": "1", "sweep": str(sweep), "running": running, "runs": states}
    text = json.dumps(facts, indent=2) + "\n"
    write_whole(out / STATE, text.encode(), GO_ON)


def summary_rows(
    out: Path, plan: Sequence[PlannedRun], states: dict[str, str]
) -> list[dict[str, Any]]:
    """One row for each run, in the sweep's order: choices, outcome and shared estimates."""
    axes = dict.fromkeys(axis for planned in plan for axis in planned.run.choices)
    rows = [_row(out, planned.run, states[planned.run.name], [*axes]) for planned in plan]
    labels = dict.fromkeys(key for row in rows for key in row)
    return [{label: row.get(label) for label in labels} for row in rows]


def write_summary(out: Path, rows: list[dict[str, Any]]) -> None:
    """Write summary.parquet in one step."""
    write_run_columns(out / SUMMARY, pa.Table.from_pylist(rows), GO_ON)


def _row(out: Path, run: SweepRun, state: str, axes: list[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"run": run.name}
    row |= {axis: run.choices.get(axis, "") for axis in axes}
    row |= {"status": state, "message": "", "doubts": ""}
    if state == NOT_RUN:
        return row
    facts = read_facts(out / run.name)
    errors = facts.get("rmse_over_sigma") or {}
    row |= {"message": facts.get("message") or "", "doubts": "; ".join(doubts_of(facts))}
    row |= {key: facts.get(key) for key in ("cost_before", "cost")}
    row |= {f"rmse_{role}": errors.get(role) for role in ("train", "test")}
    counts = ("iterations", "evaluations", "simulations", "failures", "seconds", "seed", "started")
    row |= {key: facts.get(key) for key in counts}
    path = out / run.name / "parameters.parquet"
    for each in read_run_table(path) if path.is_file() else []:
        if each["scope"] == "shared" and each["estimated_on"] == "train":
            row[f"parameter {each['label']}"] = each["value"]
    return row


def _check_strange(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise RunFolderError(f"{folder}: must be a run's folder but is a file; move it away")
    strange = {each.name for each in folder.iterdir()} - BEGUN if folder.is_dir() else set()
    if strange:
        raise RunFolderError(
            f"{folder}: must be a run's folder but holds other files, such as "
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
