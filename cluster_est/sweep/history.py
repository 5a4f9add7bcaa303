"""The history of a sweep: a row for each time that one of its runs was done.

`summary.parquet` has the last time only. A sweep that is called every night does a run again when
its config, data, FMU or versions have changed; the history says which, and what that did.
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
"""Of a hash: enough to see that something is another."""
GO_ON = "check that there is free space and that the folder can be written, and repeat the command"


def add_to_history(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Append the rows of a summary whose runs were done since the last call.

    Raises
    ------
    RunFolderError
        If the history is damaged, or a run folder is.
    UnwritableError
        If it cannot be written.
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
    """Return rows that all have the columns of any of them; None where a row had none."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def _time(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return what tells one time of a run from all others."""
    return tuple(row.get(name) for name in ("run", "started", *HISTORY_INPUTS))


def _inputs(folder: Path) -> dict[str, str]:
    """Return a short hash of each thing that the result of a run depends on."""
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
