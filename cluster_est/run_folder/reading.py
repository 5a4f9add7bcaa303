"""The files of a run folder, read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cluster_est.errors import RunFolderError


def read_facts(run_folder: Path) -> dict[str, Any]:
    """Return what run.json says.

    Raises
    ------
    RunFolderError
        If there is none, or it is damaged.
    """
    path = run_folder / "run.json"
    if not path.is_file():
        raise RunFolderError(f"{run_folder}: must be the folder of a run but has no run.json")
    try:
        facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        facts["status"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunFolderError(f"{path}: is damaged ({error}); run again") from error
    return facts


def read_run_table(path: Path) -> list[dict[str, Any]]:
    """Return the rows of one of a run's tables.

    Raises
    ------
    RunFolderError
        If it is damaged.
    """
    try:
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise RunFolderError(f"{path}: is damaged ({error}); run again") from error
    return rows
