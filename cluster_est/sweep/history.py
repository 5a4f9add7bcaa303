"""The history of a sweep: a row for each execution of a run.

`summary.parquet` contains only the last executions. A sweep that is started every night repeats a
run if its config, data, FMU or versions have changed. The history shows what changed, and the
results.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from cluster_est.run_folder.run_files import (
    HISTORY_INPUTS,
    SWEEP_HISTORY_FILE,
    RunStatus,
    read_facts,
    read_run_table,
    write_run_columns,
)
from workers.messages import content_hash

ENDED = (RunStatus.DONE, RunStatus.NOT_CONVERGED, RunStatus.FAILED)
DIGITS = 12
"""Number of digits of a hash, enough to detect a change."""
GO_ON = "check that there is free space and that the folder can be written, and repeat the command"


def add_to_history(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Append the rows of a summary whose runs ended since the last call.

    Raises
    ------
    RunFolderError
        If the history or a run folder is damaged.
    UnwritableError
        If the history cannot be written.
    """
    path = out / SWEEP_HISTORY_FILE
    known = read_run_table(path) if path.is_file() else []
    seen = {_time(row) for row in known}
    ended = [
        {**row, **_inputs(out / row["run"]), **_intervals(out / row["run"])}
        for row in rows
        if row["status"] in ENDED
    ]
    new = [row for row in ended if _time(row) not in seen]
    if new:
        write_run_columns(path, pa.Table.from_pylist(with_all_columns([*known, *new])), GO_ON)


def with_all_columns(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with the union of their columns; None for missing values."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def _time(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the values that identify one execution of a run."""
    return tuple(row.get(name) for name in ("run", "started", *HISTORY_INPUTS))


def _inputs(folder: Path) -> dict[str, str]:
    """Return short hashes of the inputs on which the result of a run depends."""
    facts = read_facts(folder)
    known = facts["config_hash"], facts["experiments"], facts["fmu"]["sha256"], facts["versions"]
    return {
        column: content_hash([json.dumps(each, sort_keys=True)])[:DIGITS]
        for column, each in zip(HISTORY_INPUTS, known, strict=True)
    }


def _intervals(folder: Path) -> dict[str, float]:
    """Return the ends of the intervals of the shared estimates."""
    path = folder / "parameters.parquet"
    found: dict[str, float] = {}
    for row in read_run_table(path) if path.is_file() else []:
        if row["scope"] == "shared" and row["estimated_on"] == "train":
            found |= {f"{end} {row['label']}": row[end] for end in ("lower95", "upper95")}
    return found
