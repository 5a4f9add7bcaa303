"""Reading of the files of a run folder, and the quality of the run according to them."""

from __future__ import annotations

import enum
import io
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.lock import is_left
from cluster_est.whole_files import MEND, SEAL, SEAL_KEY, is_damaged, is_sealed, sealed, write_whole


class RunStatus(enum.StrEnum):
    """The state of a run, as in run.json."""

    RUNNING = "running"
    DONE = "done"
    NOT_CONVERGED = "not converged"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


class RunWorth(enum.StrEnum):
    """The quality of a run."""

    GOOD = "good"
    DOUBTFUL = ""
    """The run ended with a solution, and its files contain doubts about it."""
    BAD = "bad"


def run_worth(status: str, doubts: Sequence[str]) -> RunWorth:
    """Return the quality of a fit from its status and the doubts about its solution.

    Parameters
    ----------
    status
        Status of the run.
    doubts
        Doubts about its solution, from its run.json or the summary of a sweep.
    """
    if status != RunStatus.DONE:
        return RunWorth.BAD
    return RunWorth.DOUBTFUL if doubts else RunWorth.GOOD


Rows = list[dict[str, Any]]
SWEEP_SUMMARY_FILE = "summary.parquet"
"""The table of a sweep in its folder, with a row for each run."""
SWEEP_HISTORY_FILE = "history.parquet"
"""The table of a sweep with a row for each execution of a run."""
SWEEP_STATE_FILE = "sweep.json"
"""The state of each run of a sweep, and its file."""
HISTORY_INPUTS = {
    "config_hash": "config", "data_hash": "data", "fmu_hash": "FMU", "versions_hash": "versions"
}  # fmt: skip
"""Hash columns of a history, and the names of the hashed inputs."""
WITHOUT_ESTIMATES = {"sensitivity": "sensitivity analysis", "design": "design"}
"""Runs that estimate nothing, by the key of run.json that they have."""


@dataclass(frozen=True)
class StoredRun:
    """Some contents of a run folder.

    Attributes
    ----------
    path
        The folder.
    facts
        Contents of run.json.
    tables
        Rows by name of the table; empty for a missing table.
    """

    path: Path
    facts: Mapping[str, Any]
    tables: Mapping[str, Rows]

    @property
    def ended(self) -> bool:
        """Whether the run has written its results."""
        return all((self.path / f"{name}.parquet").is_file() for name in ("parameters", "errors"))


def left_alone(run_folder: Path, status: str) -> str:
    """Return a sentence if a run has the status running but no process, otherwise ""."""
    if status != RunStatus.RUNNING or not is_left(run_folder / "evaluations"):
        return ""
    return (
        "no process on this machine works in the run folder any more; if the run was killed, "
        "continue it with --resume"
    )


def may_be_resumed(run_folder: Path) -> bool:
    """Return whether a folder contains a run that was interrupted or killed, or is running."""
    try:
        return read_facts(run_folder)["status"] in (RunStatus.RUNNING, RunStatus.INTERRUPTED)
    except RunFolderError:
        return False


def read_stored_run(run_folder: Path, tables: Sequence[str]) -> StoredRun:
    """Return the facts and the named tables of a run.

    Raises
    ------
    RunFolderError
        If there is no run, or if it is damaged.
    """
    paths = {name: run_folder / f"{name}.parquet" for name in tables}
    facts = read_facts(run_folder)
    rows = {name: read_run_table(p) if p.is_file() else [] for name, p in paths.items()}
    return StoredRun(run_folder, facts, rows)


def check_has_estimates(run_folder: Path) -> None:
    """Refuse a run of a kind that has no estimates.

    Raises
    ------
    RunFolderError
        If the run has no estimates.
    """
    for key, kind in WITHOUT_ESTIMATES.items():
        if read_facts(run_folder).get(key):
            raise RunFolderError(
                f"{run_folder}: must be the folder of fit or close-loop, but is a folder of "
                f"{kind}, which has no estimates"
            )


def read_facts(run_folder: Path) -> dict[str, Any]:
    """Return the contents of run.json.

    Raises
    ------
    RunFolderError
        If it is missing or damaged.
    """
    path = run_folder / "run.json"
    if not path.is_file():
        do = ""
        if (run_folder / SWEEP_SUMMARY_FILE).is_file():
            do = "; this is the folder of a sweep: choose the folder of one of its runs"
        raise RunFolderError(f"{run_folder}: must be the folder of a run, but has no run.json{do}")
    content = path.read_bytes()
    try:
        if is_damaged(content):
            raise ValueError("its checksum does not match")
        facts: dict[str, Any] = json.loads(content)
        facts["status"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunFolderError(
            f"{path}: is damaged ({error}); run the command again with --overwrite"
        ) from error
    facts.pop(SEAL_KEY, None)
    return facts


def read_config_text(run_folder: Path) -> str:
    """Return the resolved config of a run.

    Raises
    ------
    RunFolderError
        If it is missing or damaged.
    """
    path = run_folder / "config.toml"
    if not path.is_file():
        raise RunFolderError(
            f"{run_folder}: must hold the config of its run, but has no {path.name}"
        )
    content = path.read_bytes()
    try:
        if is_damaged(content):
            raise ValueError("its checksum does not match")
        text = content.decode()
        if not is_sealed(content) and f"# {SEAL}".startswith(text[:20]):
            raise ValueError("its end is missing")
        tomllib.loads(text)
    except ValueError as error:
        raise RunFolderError(f"{path}: is damaged ({error}); {MEND}") from error
    return text.partition("\n")[2] if is_sealed(content) else text


def is_ended(facts: Mapping[str, Any]) -> bool:
    """Return whether a run has written all its results."""
    return facts["status"] in (RunStatus.DONE, RunStatus.NOT_CONVERGED)


def write_run_columns(path: Path, table: pa.Table, advice: str) -> None:
    """Write one of a run's tables atomically, with its checksum.

    Raises
    ------
    UnwritableError
        If it cannot be written.
    """
    content = io.BytesIO()
    metadata = {**(table.schema.metadata or {}), SEAL_KEY: SEAL}
    pq.write_table(table.replace_schema_metadata(metadata), content, write_page_checksum=True)
    write_whole(path, sealed(content.getvalue()), advice)


def read_run_table(path: Path) -> list[dict[str, Any]]:
    """Return the rows of one of a run's tables.

    Raises
    ------
    RunFolderError
        If it is damaged.
    """
    rows: list[dict[str, Any]] = read_run_columns(path).to_pylist()
    return rows


def read_run_columns(path: Path) -> pa.Table:
    """Return one of a run's tables.

    Raises
    ------
    RunFolderError
        If it is damaged.
    """
    content = path.read_bytes()
    # pq.read_table would import all of pyarrow.dataset, and make columns of a folder named "k=3"
    try:
        if is_damaged(content):
            raise OSError("its checksum does not match")
        with pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True) as file:
            table = file.read()
        if not is_sealed(content):
            table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        reason = " ".join(str(error).split())  # messages of Arrow may have several lines
        raise RunFolderError(f"{path}: is damaged ({reason}); {MEND}") from error
    kept = {k: v for k, v in (table.schema.metadata or {}).items() if k != SEAL_KEY.encode()}
    return table.replace_schema_metadata(kept or None)
