"""The contents of a run folder for a report, as far as they exist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.html_report.activity import LogActivity, read_activity
from cluster_est.html_report.recorded_curves import Key, OutputCurves, recorded_curves
from cluster_est.run_folder.run_files import (
    RunStatus,
    is_ended,
    read_config_text,
    read_run_columns,
    read_stored_run,
)
from cluster_est.run_folder.run_progress import PROGRESS, ProgressTail

Row = Mapping[str, Any]
SMALL_TABLES = (
    "parameters", "errors", "constraints", "starts", "minima", "front", "correlations",
    "directions", "profiles", "intervals", "searches", "workers", "findings", "structures",
    "shapes", "ranking", "indices", "probabilities", "evidence", "precision",
    "prediction_precision", "next_input", "expected",
)  # fmt: skip
NO_ACTIVITY = LogActivity(0, (), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), ())
WIDE_TABLES = ("residuals", "trajectories", "predictions", "inputs", "states")


@dataclass(frozen=True)
class ReportedRun:
    """The contents of a run folder, for a report.

    Attributes
    ----------
    name
        Name of the folder.
    facts
        Contents of run.json.
    config
        The resolved config as text, "" if it is missing.
    tables
        Rows of each small table, by name; empty for a missing table. "progress" has the lines of
        all searches in order of time.
    wide
        residuals, trajectories, predictions, inputs and states; None for a missing table.
    activity
        Workers and failures from the log.
    path
        The folder, for the commands that use it.
    """

    name: str
    facts: Mapping[str, Any] = field(repr=False)
    config: str = field(repr=False)
    tables: Mapping[str, tuple[Row, ...]] = field(repr=False)
    wide: Mapping[str, pa.Table | None] = field(repr=False)
    activity: LogActivity = field(repr=False)
    path: Path = field(default=Path(), repr=False)

    @cached_property
    def curves(self) -> dict[Key, OutputCurves]:
        """Measured and simulated values, by experiment and output."""
        return recorded_curves(self.wide)

    def beside(self, suffix: str) -> Path:
        """Return a path next to the folder, with the same name and a suffix."""
        path = self.path if self.path.name == self.name else self.path.resolve()  # such as "."
        return path.with_name(self.name + suffix)

    @property
    def status(self) -> str:
        return str(self.facts["status"])

    @property
    def is_running(self) -> bool:
        """Whether the run has the status running."""
        return self.status == RunStatus.RUNNING

    @property
    def finished(self) -> bool:
        """Whether there are results of a fit or a loop."""
        return bool(self.tables["parameters"])

    @property
    def is_sensitivity(self) -> bool:
        """Whether it is a finished sensitivity analysis."""
        return bool(self.facts.get("sensitivity"))

    @property
    def is_design(self) -> bool:
        """Whether it is a finished design."""
        return bool(self.facts.get("design"))

    @property
    def is_loop(self) -> bool:
        return self.facts.get("verdict") is not None

    @property
    def simulated(self) -> tuple[int, int]:
        """Numbers of simulations and failures from the log, or from run.json without a log."""
        if self.activity.simulations:
            return self.activity.simulations, sum(e.count for e in self.activity.failures)
        return int(self.facts.get("simulations") or 0), int(self.facts.get("failures") or 0)

    @property
    def kind(self) -> str:
        """The kind of run in words, for the head of the page."""
        if self.is_design:
            return "Design"
        if self.is_sensitivity:
            return "Sensitivity analysis"
        return "Search for missing effects" if self.is_loop else "Fit" if self.finished else "Run"

    @property
    def too_narrow(self) -> bool:
        """Whether residuals show that the intervals are too narrow, or a loop is unexplained."""
        if self.is_loop:
            return bool(self.facts["verdict"] == "unexplained")
        return bool((self.facts.get("residuals") or {}).get("too_narrow"))

    @property
    def before(self) -> str:
        """The model of the curves and errors "before"."""
        return "fitted declared model" if self.is_loop else "start values"


def read_run(path: Path, activity: LogActivity | None = None) -> ReportedRun:
    """Read a run folder; its log is read only if `activity` is None.

    Raises
    ------
    RunFolderError
        If it is not a run folder, or one of its tables is damaged.
    """
    stored = read_stored_run(path, SMALL_TABLES)
    facts, running = stored.facts, stored.facts["status"] == RunStatus.RUNNING
    # without facts, tables belong to an earlier run in a folder that is resumed
    before = running and facts.get("verdict") is None
    tables = {name: () if before else tuple(rows) for name, rows in stored.tables.items()}
    progress = ProgressTail(path / PROGRESS)
    tables["progress"] = tuple(vars(line) for line in progress.new())
    if not running:
        progress.check()
    tables["searches"] = tables["searches"] or tables["progress"]
    curves = bool(tables["parameters"])
    config = read_config_text(path) if (path / "config.toml").is_file() else ""
    return ReportedRun(
        name=path.resolve().name,
        facts=facts,
        config=config,
        tables=tables,
        wide={name: _table(path / f"{name}.parquet") if curves else None for name in WIDE_TABLES},
        activity=activity or read_activity(path / "evaluations", ended=is_ended(facts)),
        path=path,
    )


def read_results(path: Path) -> ReportedRun:
    """Read the results of a run, without its curves, searches and log.

    Raises
    ------
    RunFolderError
        If it is not a run folder, or damaged.
    """
    stored = read_stored_run(path, ("parameters", "errors", "directions"))
    tables = {name: tuple(stored.tables.get(name, ())) for name in (*SMALL_TABLES, "progress")}
    wide = dict.fromkeys(WIDE_TABLES)
    config = read_config_text(path) if (path / "config.toml").is_file() else ""
    return ReportedRun(path.resolve().name, stored.facts, config, tables, wide, NO_ACTIVITY, path)


def other_laws(effect: Row) -> list[Row]:
    """Return the alternatives that are other laws.

    The others are the same law with a further coefficient, or written in another way.
    """
    same = ("nested", "same_law")
    return [e for e in effect.get("alternatives") or [] if not any(e.get(key) for key in same)]


def _table(path: Path) -> pa.Table | None:
    return read_run_columns(path) if path.is_file() else None
