"""Changes in the results of a sweep from one execution to the next, as in nightly sweeps."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from cluster_est.html_report.charts import Chart, Dots, ErrorBars, Line, Mark, Plot
from cluster_est.html_report.number_text import count, digits, percent
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    GridBlock,
    ReportSection,
    TableLine,
    TextBlock,
    code,
    table,
    with_unit,
)
from cluster_est.html_report.reported_run import Row
from cluster_est.html_report.scales import Scale
from cluster_est.run_folder.run_files import (
    HISTORY_INPUTS,
    SWEEP_HISTORY_FILE,
    SWEEP_STATE_FILE,
    read_run_table,
)
from workers.messages import FloatArray

MOST_FIGURES = 12
"""Largest number of runs whose errors are drawn, and of parameters of the best run."""
MOST_NAMED = 3
SECONDS = {"days": 86400.0, "hours": 3600.0}
FEWEST_DAYS = 2.0
"""Smallest number of days between the first and the last result for an axis in days."""
HEIGHT = 110
ROLES = (("rmse_train", "training", "after"), ("rmse_test", "held out", "before"))
NOTE = (
    "A sweep repeats a run when its config, data, FMU or versions have changed. The table compares "
    "the last two results. Errors are divided by sigma, which is 1 if none is given. A parameter "
    "has moved if its 95 % intervals from the two results do not overlap."
)


@dataclass(frozen=True)
class RunHistory:
    """All executions of a run of a sweep, the first one first; at least two."""

    run: str
    rows: tuple[Row, ...] = field(repr=False)

    def values(self, column: str) -> FloatArray:
        """Return a column over the executions; NaN if missing."""
        found = [row.get(column) for row in self.rows]
        return np.array([math.nan if each is None else each for each in found], np.float64)

    def change(self, column: str) -> float:
        """Return the relative increase of a number at the last execution; NaN if unknown."""
        before, now = self.values(column)[-2:]
        return float(now / before - 1.0) if before else math.nan

    @property
    def inputs(self) -> str:
        """Inputs that changed before the last execution."""
        before, now = self.rows[-2:]
        return ", ".join(
            name for column, name in HISTORY_INPUTS.items() if before.get(column) != now.get(column)
        )

    def moved(self, label: str) -> bool:
        """Return whether the last two intervals of a parameter are disjoint."""
        low, high = (self.values(f"{end} {label}")[-2:] for end in ("lower95", "upper95"))
        return bool(low.max() > high.min())


def read_history(folder: Path) -> list[RunHistory]:
    """Read the history of a sweep, including that of the same sweep in sibling folders.

    Parameters
    ----------
    folder
        Folder of the sweep. A nightly sweep may write each night to a sibling folder with a date.

    Raises
    ------
    RunFolderError
        If a history is damaged.
    """
    own, folders = _sweep_file(folder), {folder.resolve(): None}
    with suppress(OSError):  # without permission to list the parent folder, only this sweep is read
        folders |= {
            each.resolve(): None
            for each in folder.absolute().parent.iterdir()
            if own and _sweep_file(each) == own
        }
    paths = [each / SWEEP_HISTORY_FILE for each in folders]
    rows = [row for path in paths if path.is_file() for row in read_run_table(path)]
    known: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: str(row["started"])):
        known.setdefault(row["run"], []).append(row)
    return [RunHistory(name, tuple(each)) for name, each in known.items() if len(each) > 1]


def _sweep_file(folder: Path) -> str:
    """Return the sweep file of a folder; "" if it is not the folder of a sweep."""
    try:
        return str(json.loads((folder / SWEEP_STATE_FILE).read_bytes())["sweep"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def history(
    found: Sequence[RunHistory], best: str, units: Mapping[str, str], named: Mapping[str, str]
) -> ReportSection:
    """Return the section with the last changes, and errors and the best run's parameters over days.

    Parameters
    ----------
    found
        Result of `read_history`.
    best
        Name of the best run.
    units
        Units of the parameters.
    named
        Names of the runs in pictures.
    """
    blocks: list[Block] = []
    if found:
        names = ("run", "#times", "last", "changed", "#training", "#held out", "moved parameters")
        blocks = [TextBlock(NOTE), table(names, [_line(each) for each in found])]
        ranked = sorted(found, key=lambda each: -_largest(each))[:MOST_FIGURES]
        figures = [_errors(i, e, named.get(e.run, e.run)) for i, e in enumerate(ranked)]
        blocks.append(GridBlock(tuple(each for each in figures if each is not None)))
        if len(ranked) < len(found):
            said = f"The plots show the {len(ranked)} runs whose errors changed most."
            blocks.append(TextBlock(said, "faint"))
    for each in found:
        if each.run == best:
            drawn = [_parameter(i, each, label, units) for i, label in enumerate(_labels(each))]
            blocks += [TextBlock(f"Parameters of {best}", kind="heading")] if drawn else []
            blocks += [GridBlock(tuple(drawn[:MOST_FIGURES]))] if drawn else []
    return ReportSection("history", "History", tuple(blocks))


def _line(each: RunHistory) -> TableLine:
    """Return a row that compares a run's last execution with the previous one."""
    errors = []
    for column, *_ in ROLES:
        before, now = each.values(column)[-2:]
        known = math.isfinite(before) or math.isfinite(now)
        errors.append(f"{digits(before, 3)} → {digits(now, 3)}" if known else "")
    moved = [label for label in _labels(each) if each.moved(label)]
    changes = [f"{label} {_signed(each.change(f'parameter {label}'))}" for label in moved]
    more = f" and {len(moved) - MOST_NAMED} more" if len(moved) > MOST_NAMED else ""
    last = str(each.rows[-1]["started"])[:10]
    named = ", ".join(changes[:MOST_NAMED]) + more
    return code(each.run), count(len(each.rows)), last, each.inputs, *errors, named


def _signed(share: float) -> str:
    return f"{'+' if share > 0.0 else ''}{percent(share)}"


def _largest(each: RunHistory) -> float:
    """Return the largest change of its errors."""
    changes = [abs(each.change(column)) for column, *_ in ROLES]
    return max((change for change in changes if math.isfinite(change)), default=0.0)


def _labels(each: RunHistory) -> list[str]:
    """Return the names of the parameters that both of the last executions have."""
    found = [name.removeprefix("parameter ") for name in each.rows[-1] if "parameter " in name]
    return [n for n in found if np.isfinite(each.values(f"parameter {n}")[-2:]).all()]


def _since(each: RunHistory) -> tuple[FloatArray, str]:
    """Return the times of results relative to the last one, which are at most 0, and their unit."""
    began = [datetime.fromisoformat(str(row["started"])).timestamp() for row in each.rows]
    seconds = np.array(began) - began[-1]
    unit = "days" if -seconds[0] >= FEWEST_DAYS * SECONDS["days"] else "hours"
    return seconds / SECONDS[unit], unit


def _errors(number: int, each: RunHistory, title: str) -> FigureBlock | None:
    times, marks = _since(each)[0], list[Mark]()
    for column, name, ink in ROLES:
        if np.isfinite(each.values(column)).any():
            marks += [
                Line("", ink, times, each.values(column)),
                Dots(name, ink, times, each.values(column)),
            ]
    if not marks:
        return None
    known = [each.values(column) for column, *_ in ROLES]
    up = Scale.around(*known, may_be_log=True)
    up = up if up.log else Scale.around(*known, np.zeros(1))
    return _figure(f"history-{number}", each, title, "error over sigma", up, marks)


def _parameter(number: int, each: RunHistory, label: str, units: Mapping[str, str]) -> FigureBlock:
    times, value = _since(each)[0], each.values(f"parameter {label}")
    low, high = (each.values(f"{end} {label}") for end in ("lower95", "upper95"))
    marks: list[Mark] = [
        ErrorBars("", "after", times, low, high),
        Dots(label, "after", times, value),
    ]
    up = Scale.around(value, low, high)
    named = with_unit(label, units.get(label, ""))
    return _figure(f"history-of-{number}", each, label, named, up, marks)


def _figure(
    id_: str, each: RunHistory, title: str, label: str, up: Scale, marks: Sequence[Mark]
) -> FigureBlock:
    times, unit = _since(each)
    plot = Plot(title, label, Scale.around(times, np.zeros(1)), up, list(marks), HEIGHT)
    return FigureBlock(id_, title, Chart((plot,), f"{unit} until the last time", across=4))
