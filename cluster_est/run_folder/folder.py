"""The run folder: everything that a run leaves behind, as Arrow tables and two text files."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cluster_est.closed_loop.findings import tables
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.errors import RunFolderError
from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import worse_than_constants
from cluster_est.results.result import Result
from cluster_est.run_folder.evaluation_log import EvaluationLog, LogSettings
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.run_folder.progress_file import PROGRESS, ProgressFile
from cluster_est.run_folder.run_identity import FORMAT, versions
from cluster_est.running.reset_policy import ResetDecision
from cluster_est.running.runner import RunSnapshot, SearchIteration, TaskOrigin
from workers.messages import Outcome

BEGUN = {"evaluations", "config.toml", ".config.toml", PROGRESS, ".run.json"}
"""All that a folder can hold if its process was killed before it wrote run.json."""


class RunFolder:
    """Writes a run while it goes on.

    Parameters
    ----------
    path
        Must not hold a run yet, unless `overwrite`.
    problem
        What is run.
    config_text
        The resolved config as TOML.
    config_hash
        Hash of what determines the result.
    seed
        Of the method.
    overwrite
        Whether to replace the run that is there.
    log_settings
        How much of each simulation is kept.
    logged
        What the run that is there has simulated, if it is taken up again: its log goes on.
    config_folder
        The folder that the config's paths start from.
    chosen
        What every simulation begins with.

    Raises
    ------
    RunFolderError
        If the folder holds something already or cannot be written.
    """

    def __init__(
        self,
        path: Path,
        problem: Problem,
        config_text: str,
        config_hash: str,
        seed: int,
        *,
        overwrite: bool = False,
        log_settings: LogSettings | None = None,
        logged: LoggedOutcomes | None = None,
        config_folder: Path | None = None,
        chosen: ResetDecision | None = None,
    ) -> None:
        check_free(path, overwrite=overwrite or logged is not None)
        self.path = path
        self._problem, self._seed = problem, seed
        self._metadata = {"cluster_est.config_hash": config_hash, "cluster_est.format": FORMAT}
        self._config_hash = config_hash
        self._logged = logged
        self._config_folder = config_folder
        self._chosen = chosen
        self._iterations: dict[tuple[str, int, str], dict[str, Any]] = {}
        self._workers: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self._begin = time.time()
        if overwrite and path.exists():
            _remove_run(path)
        experiments = [(e.id, e.key) for e in problem.experiments]
        first = 0 if logged is None else logged.next_segment
        try:
            self._log = EvaluationLog(
                path / "evaluations",
                problem.model.key,
                experiments,
                self._metadata,
                log_settings,
                first,
            )
            _write_text(path / "config.toml", config_text)
            self._progress = ProgressFile(path / PROGRESS)
        except OSError as error:
            raise RunFolderError(f"{path}: cannot be written ({error}); choose another") from error
        self._write_status("running", {})

    def record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        """Log one simulation, unless it stands in the log since before the run was resumed."""
        if self._logged is None or not self._logged.was_answered(outcome.task):
            self._log.record(origin, outcome)
        worker = self._workers[outcome.worker]
        worker["simulations"] += 1
        worker["failures"] += not outcome.ok
        worker["busy_seconds"] += outcome.seconds

    def note(self, iteration: SearchIteration) -> None:
        """Keep the last line that a search shows for each of its iterations, and its end."""
        progress = iteration.progress
        if np.isfinite(progress.cost) or progress.ending:
            key = (iteration.search, progress.iteration, progress.ending)
            row = {"search": iteration.search, **dataclasses.asdict(progress)}
            self._iterations[key] = row | {"evaluations": iteration.evaluations}
            self._progress.iteration(iteration)

    def show(self, snapshot: RunSnapshot) -> None:
        """Let others see how far it is."""
        self._progress.show(snapshot)

    def write(self, result: Result) -> None:
        """Write all tables at the end of a run."""
        self._log.close()
        self._table("parameters", [dataclasses.asdict(e) for e in result.estimates])
        self._table("errors", [dataclasses.asdict(e) for e in result.errors])
        self._write_fit(result)
        self._write_status(_status(result), _numbers(result))

    def write_loop(self, result: LoopResult) -> None:
        """Write all tables of a closed loop: those of its last fit, and what it found."""
        self._log.close()
        for name in ("parameters", "errors", "findings", "effects", "shapes"):
            self._write_table(name, result.table(name))
        self._write_fit(result.final)
        given = any(o.sigma != 1.0 for e in self._problem.experiments for o in e.outputs)
        numbers = _numbers(result.after) | {
            "cost_before": result.before.cost,
            "evaluations": result.evaluations,
            "simulations": int(sum(w["simulations"] for w in self._workers.values())),
            "failures": int(sum(w["failures"] for w in self._workers.values())),
            "seconds": result.seconds,
            "errors_over": "sigma" if given else "estimated noise",
        }
        self._write_status("done", numbers | tables.facts(result))

    def _write_fit(self, result: Result) -> None:
        """Iterations, workers, residuals and trajectories."""
        iterations = sorted(self._iterations.values(), key=lambda row: _natural(row["search"]))
        self._table("searches", iterations)
        rows = [{"worker": name, **numbers} for name, numbers in sorted(self._workers.items())]
        seconds = result.search_seconds if np.isfinite(result.search_seconds) else result.seconds
        self._table("workers", [row | {"seconds": seconds} for row in rows])
        for name, found in result.optional_rows().items():
            if found:
                self._table(name, [dataclasses.asdict(row) for row in found])
        self._write_table("residuals", result.residuals)
        self._write_table("trajectories", result.trajectories)

    def abandon(self, reason: str, status: str = "failed") -> None:
        """Close the log of a run that ended without a result, and say so."""
        self._log.close()
        self._write_status(status, {"message": reason})

    def _table(self, name: str, rows: list[dict[str, Any]]) -> None:
        self._write_table(name, pa.Table.from_pylist(rows) if rows else pa.table({}))

    def _write_table(self, name: str, table: pa.Table) -> None:
        metadata = {**(table.schema.metadata or {}), **self._metadata}
        partial = self.path / f".{name}.parquet"
        pq.write_table(table.replace_schema_metadata(metadata), partial)
        partial.rename(self.path / f"{name}.parquet")

    def _write_status(self, status: str, numbers: dict[str, Any]) -> None:
        facts = {
            "format": FORMAT,
            "status": status,
            "verdict": None,
            **numbers,
            "seed": self._seed,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._begin)),
            "config_hash": self._config_hash,
            "config_folder": str(self._config_folder.resolve()) if self._config_folder else "",
            "fmu": {
                "name": self._problem.model.name,
                "sha256": self._problem.model.archive_hash,
                "interface": self._problem.model.interface,
                "solver": self._problem.model.solver.name,
            },
            "renewal": dataclasses.asdict(self._chosen) if self._chosen is not None else None,
            "experiments": {e.id: e.key for e in self._problem.experiments},
            "versions": versions(),
        }
        _write_text(self.path / "run.json", json.dumps(_finite(facts), indent=2) + "\n")


def check_free(path: Path, *, overwrite: bool) -> None:
    """Refuse a folder that holds something, before anything is computed.

    Raises
    ------
    RunFolderError
        If it is a file, or holds a run and `overwrite` is false, or holds something else.
    """
    if path.exists() and not path.is_dir():
        raise RunFolderError(f"{path}: must be a folder but is a file; choose another --out")
    if not path.is_dir() or not any(path.iterdir()):
        return
    if only_begun(path):
        return
    if not (path / "run.json").is_file():
        raise RunFolderError(f"{path}: must be new or empty but holds other files; choose another")
    if not overwrite:
        raise RunFolderError(
            f"{path}: holds a run already; choose another --out, or replace it with --overwrite"
        )


def only_begun(path: Path) -> bool:
    """Whether a folder holds what a run leaves that was killed before it simulated anything."""
    names = {each.name for each in path.iterdir()}
    log = path / "evaluations"
    return "evaluations" in names and names <= BEGUN and log.is_dir() and not any(log.iterdir())


def _status(result: Result) -> str:
    if result.interrupted:
        return "interrupted"
    return "done" if result.success else "not converged"


def _numbers(result: Result) -> dict[str, Any]:
    return {
        "ending": result.solution.ending.name.lower(),
        "message": result.message,
        "cost_before": result.cost_before,
        "cost": result.cost,
        "rmse_over_sigma": {"train": result.rmse("train"), "test": result.rmse("test")},
        "notes": _notes(result),
        "iterations": result.solution.iterations,
        "evaluations": result.evaluations,
        "simulations": result.simulated,
        "failures": result.failures,
        "seconds": result.seconds,
    }


def _notes(result: Result) -> list[str]:
    """What to know about the simulations and the uncertainty, in sentences."""
    notes = list(result.problem.notes())
    if result.uncertainty is not None:
        notes += result.uncertainty.sentences
    for profile in result.profiles:
        notes += profile.sentences
    return [*notes, *worse_than_constants(result.errors)]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts "start 2" before "start 10", so that no table depends on which search was faster."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _write_text(path: Path, text: str) -> None:
    """Write a file in one step."""
    partial = path.with_name(f".{path.name}")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def _finite(value: Any) -> Any:
    """JSON has no NaN: null stands for it."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _remove_run(path: Path) -> None:
    """Remove what a run wrote, and nothing else."""
    shutil.rmtree(path / "evaluations", ignore_errors=True)
    texts = [path / name for name in ("run.json", "config.toml", "report.html", PROGRESS)]
    for file in [*path.glob("*.parquet"), *texts]:
        if not file.is_dir():  # a folder of that name is not the run's
            file.unlink(missing_ok=True)
