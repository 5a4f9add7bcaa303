"""Sizes of the errors: compared with the noise at the head of a page, and in tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, Literal

import numpy as np

from cluster_est.html_report.charts import (
    Dots,
    Line,
    Mark,
    Rules,
    row_chart,
)
from cluster_est.html_report.number_text import count, digits, percent
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    ReportSection,
    TableBlock,
    TableCell,
    TableLine,
    TextBlock,
    Tone,
    code,
    table,
)
from cluster_est.html_report.reported_run import ReportedRun, Row
from cluster_est.html_report.scales import Scale

MOST_EXPERIMENT_ROWS = 24
"""Largest number of rows for single outputs of experiments; otherwise a row is an output."""
ROW_PIXELS = 22
FitStage = Literal["before", "after"]


@dataclass(frozen=True)
class ErrorSizes:
    """The errors of a run relative to a measure of their size.

    Attributes
    ----------
    measure
        Name of the divisor.
    is_noise
        Whether the divisor is the noise, so that no model can be better than 1.
    rows
        Rows of errors.parquet.
    divisors
        Additional divisor of each row's normalised error.
    """

    measure: str
    is_noise: bool
    rows: tuple[Row, ...] = field(repr=False)
    divisors: tuple[float, ...] = field(repr=False)

    def of(self, chosen: Sequence[int], when: FitStage) -> float:
        """Return the root mean square over the samples of some rows; NaN if one of them failed."""
        name = f"{'normalised' if self.is_noise else 'relative'}_{when}"
        return _pooled([self.rows[i] for i in chosen], name, [self.divisors[i] for i in chosen])

    def noise(self, row: int) -> float:
        """Return the noise of a row's output in its unit; NaN if unknown."""
        own, size = self.rows[row], self.of([row], "after")
        return own["rmse_after"] / size if self.is_noise and size > 0.0 else math.nan

    def words(self, size: float) -> str:
        """Return the size of an error in words, such as "1.02 times the noise"."""
        return (
            f"{digits(size, 3)} times the noise"
            if self.is_noise
            else f"{percent(size)} of the signal"
        )

    def said(self, chosen: Sequence[int]) -> str:
        """Return the error of some rows in words, in the unit of their output and relative."""
        size = self.of(chosen, "after")
        own = [self.rows[i] for i in chosen]
        if math.isnan(size):
            return ""
        if len({row["output"] for row in own}) > 1:
            return f"error {self.words(size)}"
        unit = f" {own[0]['unit']}" if own[0]["unit"] else ""
        return f"error {digits(_pooled(own, 'rmse_after'), 3)}{unit}, {self.words(size)}"

    def of_role(self, role: str) -> list[int]:
        """Return the rows of training or of held-out experiments."""
        return [i for i, row in enumerate(self.rows) if row["role"] == role]


def error_sizes(run: ReportedRun) -> ErrorSizes:
    """Return the errors relative to the noise if known, otherwise to the size of the signals."""
    rows = run.tables["errors"]
    if run.is_loop:
        measure = {
            "estimated noise": "the estimated noise",
            "predicted spread": "the error that the remaining noise explains",
        }.get(str(run.facts.get("errors_over")), "the declared noise (sigma)")
        return ErrorSizes(measure, True, rows, (1.0,) * len(rows))
    outputs: Mapping[str, Mapping[str, Any]] = {
        each["output"]: each for each in (run.facts.get("residuals") or {}).get("outputs") or ()
    }
    noise = [_noise(outputs.get(row["output"])) for row in rows]
    if not rows or not all(map(math.isfinite, noise)):
        return ErrorSizes("the signal's standard deviation", False, rows, (1.0,) * len(rows))
    declared = {bool(outputs[row["output"]]["declared"]) for row in rows}
    measure = (
        "the declared noise (sigma)"
        if declared == {True}
        else "the estimated noise"
        if declared == {False}
        else "the noise, declared or estimated"
    )
    return ErrorSizes(measure, True, rows, tuple(noise))


def _noise(output: Mapping[str, Any] | None) -> float:
    """Return the noise of an output in units of sigma, NaN if unknown."""
    if output is None:
        return math.nan
    if output["declared"]:
        return 1.0
    found = output["noise_over_sigma"]
    return float(found) if found else math.nan


def error_sentence(run: ReportedRun) -> str:
    """Compare the errors before and after with the noise, for training and held-out experiments."""
    sizes = error_sizes(run)
    parts: list[str] = []
    last = ""
    for role, where in (("train", "training"), ("test", "held-out")):
        chosen = sizes.of_role(role)
        before, after = sizes.of(chosen, "before"), sizes.of(chosen, "after")
        if math.isnan(after):
            continue
        moved = "fell" if after < before else "rose" if after > before else "is"
        size = digits(after, 3)
        if moved != "is":
            size = f"from {digits(before, 3)} to {size}"
        verb = "" if moved == last else f"{moved} "
        measured = "" if parts else f" times {sizes.measure}"
        parts.append(f"{verb}{size}{measured} on {where} experiments")
        last = moved
    return f"The error {' and '.join(parts)}." if parts else ""


def error_picture(run: ReportedRun) -> FigureBlock | None:
    """Return the picture of errors before and after, and of noise; None without errors."""
    sizes = error_sizes(run)
    groups = _groups(sizes)
    if not groups:
        return None
    place = np.arange(len(groups), dtype=float)
    before, after = (
        np.array([sizes.of(chosen, when) for chosen in groups.values()])
        for when in ("before", "after")
    )
    path_x = np.column_stack([before, after, np.full(len(place), np.nan)]).ravel()
    path_y = np.column_stack([place, place, np.full(len(place), np.nan)]).ravel()
    marks: list[Mark] = [
        Rules("noise", "measured", x=(1.0,)) if sizes.is_noise else Rules("", "faint"),
        Line("", "faint", path_x, path_y),
        Dots("before", "before", before, place),
        Dots("after", "after", after, place),
    ]
    ends = np.array([1.0 if sizes.is_noise else 0.0])
    across = Scale.around(before[before > 0.0], after[after > 0.0], ends, may_be_log=True)
    title = f"Error before and after, relative to {sizes.measure}"
    names = list(groups)
    note = f"Before: {run.before}."
    if sizes.is_noise:
        note += " The error of a complete model is close to the noise line."
    if sizes.is_noise and "estimated" in sizes.measure:
        note += " The noise of an output is estimated over all training experiments together."
    below = f"error over {sizes.measure}"
    chart = row_chart(title, below, across, marks, names, height=ROW_PIXELS)
    return FigureBlock("before-and-after", title, chart, note)


def _groups(sizes: ErrorSizes) -> dict[str, list[int]]:
    """Return the rows of the picture: names, and the errors that each of them combines."""
    found: dict[str, list[int]] = {}
    single = len({row["output"] for row in sizes.rows}) == 1
    for i, row in enumerate(sizes.rows):
        held = " (held out)" if row["role"] == "test" else ""
        if len(sizes.rows) <= MOST_EXPERIMENT_ROWS:
            own = row["experiment"] if single else f"{row['experiment']}, {row['output']}"
        else:
            own = row["output"]
        found.setdefault(f"{own}{held}", []).append(i)
    return {name: chosen for name, chosen in found.items() if _known(sizes, chosen)}


def _known(sizes: ErrorSizes, chosen: Sequence[int]) -> bool:
    return not math.isnan(sizes.of(chosen, "after"))


ROLES = {"train": "training", "test": "held out"}
MOST_UNFOLDED_ROWS = 24
"""Largest number of rows with which the table by experiment is not folded."""


MOST_OUTPUT_ROWS = 6
"""Number of rows of the table by output, which has the largest errors."""


def error_table(run: ReportedRun) -> list[Block]:
    """Return a table of the error of each output over all experiments, in its unit and relative."""
    sizes = error_sizes(run)
    outputs: dict[tuple[str, str], list[int]] = {}
    for i, row in enumerate(sizes.rows):
        outputs.setdefault((row["output"], row["role"]), []).append(i)
    groups = [
        chosen for chosen in outputs.values() if any(sizes.rows[i]["samples"] for i in chosen)
    ]
    kept = sorted(groups, key=lambda chosen: -_or_largest(sizes.of(chosen, "after")))
    kept = kept[:MOST_OUTPUT_ROWS]
    lines = [_output_line(sizes, chosen) for chosen in groups if chosen in kept]
    over = ("#over noise",) if sizes.is_noise else ()
    names = ("error of", "", "#before", "#after", "unit", *over, "#of signal")
    left = len(groups) - len(kept)
    more = [TextBlock(f"{left} smaller errors: see the section Errors.", "faint")]
    return [table(names, lines), *(more if left else [])] if lines else []


def _or_largest(size: float) -> float:
    """Return an error; infinity if its simulation failed."""
    return math.inf if math.isnan(size) else size


def _output_line(sizes: ErrorSizes, chosen: Sequence[int]) -> TableLine:
    rows = [sizes.rows[i] for i in chosen]
    before, after = (_pooled(rows, f"rmse_{when}") for when in ("before", "after"))
    over = (digits(sizes.of(chosen, "after"), 3),) if sizes.is_noise else ()
    role = TableCell(ROLES.get(str(rows[0]["role"]), ""), "faint")
    now = TableCell("failed", "bad") if math.isnan(after) else TableCell(digits(after, 3))
    share = percent(_pooled(rows, "relative_after"))
    return code(rows[0]["output"]), role, digits(before, 3), now, rows[0]["unit"], *over, share


def errors(run: ReportedRun) -> ReportSection:
    """Return the section with a picture of errors and noise, and a table of errors."""
    rows = run.tables["errors"]
    if not rows:
        return ReportSection("errors", "Errors", ())
    said = (
        f"Root mean square of measured minus simulated values. Before: {run.before}. The column "
        '"of the signal" shows the error after, as a share of the standard deviation of the '
        "measured signal."
    )
    folded = len(rows) > MOST_UNFOLDED_ROWS
    picture = error_picture(run)
    blocks: list[Block] = [] if picture is None else [picture]
    blocks += [TextBlock(said), _table(rows, folded=folded)]
    return ReportSection("errors", "Errors before and after", tuple(blocks))


def _table(rows: Sequence[Row], *, folded: bool) -> TableBlock:
    sizes = "#before", "#after", "unit", "#change", "#of the signal", "#samples"
    lines = []
    for row in rows:
        before, after = row["rmse_before"], row["rmse_after"]
        of = code(row["output"]), TableCell(ROLES.get(str(row["role"]), ""), "faint")
        change = _change(before, after) if row["samples"] else TableCell("")
        share, samples = percent(row["relative_after"]), count(row["samples"])
        who = str(row["experiment"])
        lines.append((*of, who, digits(before), digits(after), row["unit"], change, share, samples))
    return table(("output", "", "experiment", *sizes), lines, "By experiment", folded=folded)


def _pooled(rows: Sequence[Row], name: str, divisors: Sequence[float] = ()) -> float:
    """Return the root mean square over samples of rows, over divisors; NaN without samples."""
    sizes = [
        (row["samples"], row[name] / divisor)
        for row, divisor in zip(rows, divisors or repeat(1.0), strict=False)
        if row["samples"]  # rows without samples have no error, but did not fail
    ]
    squares, samples = sum(n * size**2 for n, size in sizes), sum(n for n, _ in sizes)
    return math.sqrt(squares / samples) if samples else math.nan


def _change(before: float, after: float) -> TableCell:
    if math.isnan(before) or math.isnan(after) or before <= 0.0:
        return TableCell("failed", "bad") if math.isnan(after) else TableCell("")
    share = after / before - 1.0
    tone: Tone = "good" if share < -0.005 else "bad" if share > 0.005 else "faint"
    sign = "+" if share > 0.0 else ""
    return TableCell(f"{sign}{percent(share)}" if abs(share) >= 5e-4 else "none", tone)
