"""The run folder: all files that a run writes, as Arrow tables and two text files."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from cluster_est.errors import ClusterEstError, RunFolderError, UnwritableError
from cluster_est.problem.problem import Problem
from cluster_est.results.fit_tables import coefficient_units
from cluster_est.run_folder.evaluation_log import EvaluationLog
from cluster_est.run_folder.lock import LOCK, OWNER, RunLock
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.run_folder.run_files import (
    RunStatus,
    may_be_resumed,
    read_facts,
    write_run_columns,
)
from cluster_est.run_folder.run_identity import FORMAT, RunIdentity, RunKind, versions
from cluster_est.run_folder.run_progress import PROGRESS, ProgressFile
from cluster_est.running.reset_policy import ResetDecision
from cluster_est.running.resources import RunSnapshot, SearchIteration, TaskOrigin
from cluster_est.whole_files import (
    ELSEWHERE,
    MAKE_ROOM_AND_RESUME,
    SEAL,
    SEAL_KEY,
    sealed,
    write_whole,
    writing,
)
from workers.messages import Outcome

BEGUN = {"evaluations", "config.toml", ".config.toml", PROGRESS, ".run.json"}
"""Files that a folder may contain if its process was killed before it wrote run.json."""


class RunResult(Protocol):
    """A result that a folder can store: that of a fit or of a closed loop."""

    @property
    def tables(self) -> Sequence[str]:
        """Names of its tables."""

    def table(self, name: str) -> pa.Table:
        """Return one of its tables."""

    def facts(self) -> Mapping[str, Any]:
        """Return the contents of run.json for this result, including its status."""

    @property
    def search_seconds(self) -> float:
        """Duration of its searches in seconds."""


class RunFolder:
    """Writes the files of a run while it is running.

    Parameters
    ----------
    path
        Must not contain a run yet, unless `overwrite`.
    identity
        Identity of the run.
    logged
        Logged simulations of the existing run, if it is resumed; its log is continued.
    overwrite
        Whether to replace an existing run.
    held
        Lock of the folder, if already taken.
    say
        Called with a sentence for the user about the log.

    Raises
    ------
    RunFolderError
        If the folder contains something already or is not writable.
    """

    def __init__(
        self,
        path: Path,
        identity: RunIdentity,
        logged: LoggedOutcomes | None = None,
        *,
        overwrite: bool = False,
        held: RunLock | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        check_free(path, overwrite=overwrite or logged is not None)
        path = path.absolute()  # an FMU being loaded changes the working folder
        self.path = path
        self._identity, self._problem = identity, identity.problem
        self._config_hash = identity.config_hash
        self._metadata = {
            "cluster_est.config_hash": self._config_hash,
            "cluster_est.format": FORMAT,
        }
        self._logged = logged
        self._reset: ResetDecision | None = None
        self._iterations: dict[tuple[str, int, str], dict[str, Any]] = {}
        self._workers: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self._so_far: dict[str, Any] = {} if logged is None else _found_before(path)
        self._begin = time.time()
        self._variables = _explained(self._problem)
        self._lock = held or take_folder(path)
        try:
            check_free(path, overwrite=overwrite or logged is not None)  # again, now locked
            with writing(path, ELSEWHERE):
                if overwrite:
                    _remove_run(path)
                self._log = self._open_log(say)
                self._progress = ProgressFile(path / PROGRESS)
            text = f"# {SEAL}\n{identity.config_text}"
            write_whole(path / "config.toml", sealed(text.encode()), ELSEWHERE)
            self._write_status(RunStatus.RUNNING, {})
        except BaseException:
            self._lock.release()
            raise

    def _open_log(self, say: Callable[[str], None] | None) -> EvaluationLog:
        return EvaluationLog(
            self.path / "evaluations",
            self._problem.model.key,
            [(e.id, e.key) for e in self._problem.experiments],
            self._metadata,
            self._identity.log,
            0 if self._logged is None else self._logged.next_segment,
            say=say,
        )

    def note_reset(self, decision: ResetDecision) -> None:
        """Store the reset policy of all simulations."""
        self._reset = decision
        self._write_status(RunStatus.RUNNING, {})

    def record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        """Log one simulation, unless it was answered from the log of the resumed run."""
        if self._logged is None or not self._logged.was_answered(outcome.task):
            self._log.record(origin, outcome)
        worker = self._workers[outcome.worker]
        worker["simulations"] += 1
        worker["failures"] += outcome.failed
        worker["busy_seconds"] += outcome.seconds

    def note(self, iteration: SearchIteration) -> None:
        """Store the last line of each iteration of a search, and its end.

        Of several searches of the same name, the best line is stored, independent of their speed.
        """
        progress = iteration.progress
        if np.isfinite(progress.cost) or progress.ending:
            key = (iteration.search, progress.iteration, progress.ending)
            row = {"search": iteration.search, **dataclasses.asdict(progress)}
            row["evaluations"] = iteration.evaluations
            self._iterations[key] = max(self._iterations.get(key, row), row, key=_lateness)
            self._progress.iteration(iteration)

    def show(self, snapshot: RunSnapshot) -> None:
        """Write the state of the run to the progress file."""
        self._progress.show(snapshot)

    @property
    def has_results(self) -> bool:
        """Whether an intermediate result was stored."""
        return bool(self._so_far)

    def keep(self, result: RunResult) -> None:
        """Write the tables of an intermediate result, while the run continues."""
        for name in result.tables:
            self._write_table(name, result.table(name))
        self._so_far = {**result.facts(), "status": RunStatus.RUNNING}
        self._write_status(RunStatus.RUNNING, {})

    def write(self, result: RunResult) -> RunStatus:
        """Write all tables at the end of a run, and return its status."""
        self._log.close()
        self._progress.end()
        for name in result.tables:
            self._write_table(name, result.table(name))
        self._write_searches()
        facts = dict(result.facts())
        if self._identity.kind is RunKind.CLOSED_LOOP and self._workers:
            for name in ("simulations", "failures"):  # of all runners, not only of the last one
                facts[name] = int(sum(worker[name] for worker in self._workers.values()))
        searched = result.search_seconds
        self._write_workers(searched if np.isfinite(searched) else facts["seconds"])
        status = RunStatus(facts["status"])
        self._so_far = {}
        self._write_status(status, facts)
        if status is RunStatus.DONE:  # a run with another status may be resumed
            if self._logged is not None:
                self._logged.close()
            self._log.let_residuals_go()
        self._lock.release()
        return status

    def _write_searches(self) -> None:
        def place(row: Mapping[str, Any]) -> tuple[Any, int, str]:
            return _natural(row["search"]), row["iteration"], row["ending"]

        self._table("searches", sorted(self._iterations.values(), key=place))

    def _write_workers(self, seconds: float) -> None:
        rows = [{"worker": name, **numbers} for name, numbers in sorted(self._workers.items())]
        self._table("workers", [row | {"seconds": seconds} for row in rows])

    def abandon(self, reason: str, status: RunStatus) -> None:
        """Close the log of a run that ended without a result, and write the reason if possible."""
        with suppress(UnwritableError):  # lost simulations are repeated
            self._log.close()
        self._progress.end()
        with suppress(UnwritableError):
            self._write_status(status, {"message": reason})
        self._lock.release()

    def _table(self, name: str, rows: list[dict[str, Any]]) -> None:
        self._write_table(name, pa.Table.from_pylist(rows) if rows else pa.table({}))

    def _write_table(self, name: str, table: pa.Table) -> None:
        metadata = {**(table.schema.metadata or {}), **self._metadata}
        path = self.path / f"{name}.parquet"
        write_run_columns(path, table.replace_schema_metadata(metadata), MAKE_ROOM_AND_RESUME)

    def _write_status(self, status: RunStatus, numbers: dict[str, Any]) -> None:
        base, file = self._identity.base, self._identity.config_file
        facts = {
            "format": FORMAT,
            "status": status,
            "verdict": None,
            **(self._so_far | numbers | {"status": status}),
            "seed": self._identity.seed,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._begin)),
            "config_hash": self._config_hash,
            "config_folder": "" if base is None else str(base.resolve()),
            "config_file": "" if file is None else str(file.resolve()),
            "fmu": {
                "name": self._problem.model.name,
                "sha256": self._problem.model.archive_hash,
                "interface": self._problem.model.interface,
                "solver": self._problem.model.solver.name,
            },
            "reset_policy": dataclasses.asdict(self._reset) if self._reset is not None else None,
            "variables": self._variables,
            "experiments": {e.id: e.key for e in self._problem.experiments},
            "versions": versions(),
        }
        text = json.dumps({SEAL_KEY: SEAL, **_finite(facts)}, indent=2) + "\n"
        write_whole(self.path / "run.json", sealed(text.encode()), MAKE_ROOM_AND_RESUME)


def _explained(problem: Problem) -> dict[str, dict[str, dict[str, str]]]:
    """Return unit and description of each parameter and output, for those who watch the run."""
    try:
        variables = problem.describe().variables
        units = coefficient_units(problem)
    except ClusterEstError:  # the run itself says so
        return {}
    found: dict[str, dict[str, dict[str, str]]] = {"parameters": {}, "outputs": {}}
    for parameter in problem.parameters:
        known = variables.get(parameter.target)
        unit = parameter.unit or units.get(parameter.name, "" if known is None else known.unit)
        text = "" if known is None else known.description
        found["parameters"][parameter.name] = {"unit": unit, "description": text}
    for output in (o for experiment in problem.experiments for o in experiment.outputs):
        known = variables.get(output.variable)
        found["outputs"][output.variable] = {
            "unit": "" if known is None or output.ordinal else known.unit,
            "description": "" if known is None else known.description,
        }
    return found


def _found_before(path: Path) -> dict[str, Any]:
    """Return the previous findings of a resumed loop, whose tables still exist."""
    with suppress(RunFolderError):
        facts = read_facts(path)
        return {} if facts.get("verdict") is None else facts
    return {}


def check_free(path: Path, *, overwrite: bool) -> None:
    """Check, before any computation, that a folder may be used for a run.

    Raises
    ------
    RunFolderError
        If it is a file, or contains a run and `overwrite` is false, or contains other files.
    """
    if path.exists() and not path.is_dir():
        raise RunFolderError(f"{path}: must be a folder, but is a file; choose another --out")
    if not path.is_dir() or not any(path.iterdir()):
        return
    if only_begun(path):
        return
    if not (path / "run.json").is_file():
        raise RunFolderError(
            f"{path}: must be a new or empty folder, but holds other files; choose another folder"
        )
    if not overwrite:
        how = "choose another --out, or replace it with --overwrite"
        if may_be_resumed(path):
            how = f"continue the run with --resume, {how}"
        raise RunFolderError(f"{path}: holds a run already; {how}")


def only_begun(path: Path) -> bool:
    """Return whether a folder contains only files of a run that was killed at its start."""
    names = {each.name for each in path.iterdir()}
    log = path / "evaluations"
    if "evaluations" not in names or not names <= BEGUN or not log.is_dir():
        return False
    return {each.name for each in log.iterdir()} <= {LOCK, OWNER}


def take_folder(path: Path) -> RunLock:
    """Lock the folder of a run, which is created if missing.

    Raises
    ------
    RunFolderError
        If another process has locked it, or it cannot be created.
    """
    log = path / "evaluations"
    with writing(path, ELSEWHERE):
        path.mkdir(parents=True, exist_ok=True)
    with writing(log, ELSEWHERE):
        log.mkdir(exist_ok=True)
    return RunLock(log)


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts "start 2" before "start 10", independent of their order of ending."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _finite(value: Any) -> Any:
    """Return a value with null instead of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _remove_run(path: Path) -> None:
    """Remove only the files that a run wrote."""
    for each in (path / "evaluations").iterdir():
        if each.name not in (LOCK, OWNER):
            each.unlink()
    texts = [path / name for name in ("run.json", "config.toml", "report.html", PROGRESS)]
    for file in [*path.glob("*.parquet"), *texts]:
        if not file.is_dir():  # a folder of that name does not belong to the run
            file.unlink(missing_ok=True)


def _lateness(row: Mapping[str, Any]) -> tuple[float, ...]:
    """Return a key of lines of an iteration: later within a search, better between searches."""
    worse = (row["violation"], row["cost"])
    return (row["evaluations"], *(-np.nan_to_num(each, nan=np.inf) for each in worse))
