"""Measured, before, after and residual curves of every experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.html_report.charts import Band, Chart, Dots, Line, Mark, Plot, Rules, Scale
from cluster_est.html_report.number_text import TimeUnit, count, digits, time_unit
from cluster_est.html_report.page_blocks import (
    CurvePanel,
    PanelsBlock,
    ReportSection,
    TextBlock,
    with_unit,
)
from cluster_est.html_report.reported_run import ReportedRun, Row
from cluster_est.problem.tables.gaps import long_steps
from workers.messages import FloatArray, IntArray


def extremes(x: FloatArray, y: FloatArray, columns: int) -> IntArray:
    """Return indices into a curve that keep what is seen of it in so many columns.

    The range of x is cut into columns of equal width. Of each, the samples with the lowest and the
    highest y are kept, and the first and last of all. Samples in a column are one above the other
    when it is a pixel wide, so that only samples that others hide are left out.

    Parameters
    ----------
    x : (n,)
        Finite, in any order; it is drawn in the order of the samples.
    y : (n,)
        NaN is taken for no sample; ends of gaps are kept, so that gaps stay gaps, unless there are
        more of them than columns.
    columns
        Across the plot.

    Returns
    -------
    (k,) ascending indices, all where there are no more than two for each column
    """
    size = len(x)
    if size <= 2 * columns + 2:
        return np.arange(size)
    known = np.isfinite(y)
    kept = [np.array([0, size - 1])]
    gaps = np.flatnonzero(known[1:] != known[:-1])
    if len(gaps) <= columns:
        kept += [gaps, gaps + 1]
    at = np.flatnonzero(known)
    place = column_of(x, columns)[at]
    order = np.lexsort((at, y[at], place))
    groups = np.flatnonzero(np.diff(place[order]))
    if len(order):
        kept += [at[order[np.append(0, groups + 1)]], at[order[np.append(groups, len(order) - 1)]]]
    return np.unique(np.concatenate(kept))


def column_of(x: FloatArray, columns: int) -> IntArray:
    """The column that each sample stands in, from 0 on."""
    low, span = float(x.min()), float(np.ptp(x)) or 1.0
    return np.minimum(((x - low) / span * columns).astype(np.int64), columns - 1)


MOST_CURVE_POINTS = 90_000
"""Points of all curves together: about 7 bytes each in the page."""
FEWEST_COLUMNS_OF_CHART, MOST_COLUMNS_OF_CHART = 20, 600
"""Limits of the columns of a chart, each with the lowest and the highest sample of every curve."""
MOST_CURVE_PANELS = 250
FEW_SAMPLES = 150
"""Number of measured values up to which they are dots."""
CURVES = (("measured", "measured"), ("before", "before"), ("after", "after"))
"""Names and inks."""
HEIGHT, RESIDUAL_HEIGHT = 170, 84
Key = tuple[str, str]


@dataclass(frozen=True)
class OutputCurves:
    """One output of one experiment: what was measured and simulated, at the measured times.

    `before` is NaN where it is not known; `fine` are the simulated curves with a time of their own;
    `band` is where the output lies by the posterior.
    """

    time: FloatArray = field(repr=False)
    measured: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)
    fine: tuple[FloatArray, FloatArray, FloatArray] | None = field(default=None, repr=False)
    band: tuple[FloatArray, FloatArray] | None = field(default=None, repr=False)


def curves(run: ReportedRun) -> ReportSection:
    """Every output of every experiment as a small chart, the most telling one in large."""
    table = run.residuals
    if table is None or not table.num_rows:
        return ReportSection("curves", "Curves", ())
    measured, simulated = _parts(table), _parts(run.trajectories)
    predicted = _parts(run.predictions)
    known = {
        key: _curves(part, simulated.get(key), predicted.get(key)) for key, part in measured.items()
    }
    errors = {(row["experiment"], row["output"]): row for row in run.tables["errors"]}
    roles = {key: str(part["role"][0].as_py()) for key, part in measured.items()}
    first = _most_telling(errors, list(known))
    shown = list(known) if len(known) <= MOST_CURVE_PANELS else _largest(errors, list(known))
    columns = int(
        np.clip(
            MOST_CURVE_POINTS / (10 * len(shown)), FEWEST_COLUMNS_OF_CHART, MOST_COLUMNS_OF_CHART
        )
    )
    unit = time_unit(max((_span(each.time) for each in known.values()), default=0.0))
    panels = [
        CurvePanel(
            experiment=key[0],
            output=key[1],
            note=_note(roles[key], errors.get(key)),
            chart=_chart(key, known[key], errors.get(key), unit, columns),
            first=key == first,
        )
        for key in shown
    ]
    inks = tuple(each for each in CURVES if _has(known, each[0]))
    text = TextBlock(_how(run, known, len(shown), columns))
    return ReportSection(
        "curves", "Measured and simulated", (text, PanelsBlock(tuple(panels), inks))
    )


def _how(run: ReportedRun, known: Mapping[Key, OutputCurves], shown: int, columns: int) -> str:
    """Say what is drawn and what is left out."""
    said = f"Before: {run.before}. The lower part of each chart is measured minus simulated."
    longest = max(len(each.measured) for each in known.values())
    if longest > 2 * columns + 2:
        samples = sum(len(each.measured) for each in known.values())
        said += (
            f" Of {count(samples)} measured values, each of {columns} columns of a chart shows "
            "the lowest and the highest, so that no peak is lost; zooming in shows no other "
            "values."
        )
    else:
        said += " Every sample is drawn."
    if any(each.band is not None for each in known.values()):
        said += (
            " The shaded band shows the output for the posterior of the values; it does not "
            "include the noise of a measurement."
        )
    if shown < len(known):
        said += f" Of {count(len(known))} charts the {shown} with the largest errors are drawn."
    return said


def _has(known: Mapping[Key, OutputCurves], name: str) -> bool:
    return any(np.isfinite(getattr(each, name)).any() for each in known.values())


def _size(row: Row | None, name: str) -> float:
    value = math.nan if row is None else row[name]
    return -1.0 if value is None or math.isnan(value) else float(value)


def _most_telling(errors: Mapping[Key, Row], keys: Sequence[Key]) -> Key:
    """Where the error has changed most."""

    def change(key: Key) -> float:
        row = errors.get(key)
        return abs(_size(row, "normalised_before") - _size(row, "normalised_after"))

    return max(keys, key=change)


def _largest(errors: Mapping[Key, Row], keys: Sequence[Key]) -> list[Key]:
    """Return the curves with the largest errors, in their order."""
    ranked = sorted(keys, key=lambda key: -_size(errors.get(key), "normalised_after"))
    kept = set(ranked[:MOST_CURVE_PANELS])
    return [key for key in keys if key in kept]


def _note(role: str, row: Row | None) -> str:
    parts = ["held out"] if role == "test" else []
    if row is not None:
        unit = f" {row['unit']}" if row["unit"] else ""
        before, after = digits(row["rmse_before"], 3), digits(row["rmse_after"], 3)
        parts.append(f"error {before} \u2192 {after}{unit}")
    return ", ".join(parts)


def _chart(key: Key, each: OutputCurves, row: Row | None, unit: TimeUnit, columns: int) -> Chart:
    """The chart of one output of one experiment."""
    name, quantity = " of ".join(reversed(key)), row["unit"] if row is not None else ""
    if not np.isfinite(each.time).any():
        return _distances(name, each, columns)
    time = each.time / unit.seconds
    upper: list[Mark] = []
    if each.band is not None:
        upper.append(_band(time, each.band, columns))
    few = len(time) <= FEW_SAMPLES
    measured = Dots("measured", "measured", time, each.measured)
    upper.append(measured if few else broken_line("measured", time, each.measured, columns))
    lower: list[Mark] = [Rules("", "faint", y=(0.0,))]
    fine_time, fine_after, fine_before = each.fine or (each.time, each.after, each.before)
    for label, curve, fine in (
        ("before", each.before, fine_before),
        ("after", each.after, fine_after),
    ):
        if np.isfinite(curve).any():
            upper.append(broken_line(label, fine_time / unit.seconds, fine, columns))
            lower.append(broken_line(label, time, each.measured - curve, columns))
    x = Scale.around(time, fine_time / unit.seconds, margin=0.0)
    values = (each.measured, fine_after, fine_before, *(each.band or ()))
    rest = (each.measured - each.after, each.measured - each.before)
    plots = (
        Plot(f"{name}: measured and simulated over time", with_unit(key[1], quantity), x,
             Scale.around(*values), upper, HEIGHT),
        Plot(f"{name}: measured minus simulated over time", with_unit("residual", quantity), x,
             Scale.around(*rest, np.zeros(1)), lower, RESIDUAL_HEIGHT),
    )  # fmt: skip
    return Chart(plots, f"time ({unit.name})", legend=False, across=5)


def _band(time: FloatArray, band: tuple[FloatArray, FloatArray], columns: int) -> Band:
    """The band at evenly spaced measured times: it is smooth."""
    kept = np.unique(np.linspace(0, len(time) - 1, min(len(time), columns)).astype(int))
    return Band("posterior", "after", time[kept], band[0][kept], band[1][kept])


def _distances(name: str, each: OutputCurves, columns: int) -> Chart:
    """Of a curve without times: how far each of its segments is from what was simulated."""
    segment = np.arange(len(each.residual), dtype=float)
    marks = [broken_line("after", segment, each.residual, columns)]
    plot = Plot(
        f"{name}: distance of each segment",
        "distance, relative",
        Scale.around(segment, margin=0.0),
        Scale.around(each.residual, np.zeros(1)),
        marks,
        HEIGHT + RESIDUAL_HEIGHT,
    )
    return Chart((plot,), "segment", legend=False, across=5)


def broken_line(name: str, x: FloatArray, y: FloatArray, columns: int) -> Line:
    """Return a line through samples, but not across gaps between them."""
    gaps = long_steps(x)
    behind = np.searchsorted(x, gaps[:, 1])
    x, y = np.insert(x, behind, gaps.mean(axis=1)), np.insert(y, behind, np.nan)
    kept = extremes(x, y, columns)
    return Line(name, name, x[kept], y[kept])


def _span(time: FloatArray) -> float:
    known = time[np.isfinite(time)]
    return float(np.ptp(known)) if len(known) else 0.0


def _curves(table: pa.Table, finer: pa.Table | None, predicted: pa.Table | None) -> OutputCurves:
    """The rows of one output of one experiment as curves."""
    time, measured, after, before, residual = (
        _column(table, name)
        for name in ("time", "measured", "simulated", "simulated_before", "residual")
    )
    fine = None
    if finer is not None and finer.num_rows > len(time):
        own, *both = (_column(finer, n) for n in ("time", "simulated", "simulated_before"))
        if np.isfinite(both[0]).any():
            fine = own, both[0], both[1]
    band = None
    if predicted is not None and predicted.num_rows == len(time):
        band = _column(predicted, "lower"), _column(predicted, "upper")
    return OutputCurves(time, measured, after, before, residual, fine, band)


def _parts(table: pa.Table | None) -> dict[Key, pa.Table]:
    """The rows of each output of each experiment, which stand behind each other in the table."""
    if table is None or not {"experiment", "output"} <= set(table.column_names):
        return {}
    encoded = [
        table[name].combine_chunks().dictionary_encode() for name in ("experiment", "output")
    ]
    codes = np.array([np.asarray(each.indices) for each in encoded])
    changes = np.flatnonzero((codes[:, 1:] != codes[:, :-1]).any(axis=0)) + 1
    found: dict[Key, pa.Table] = {}
    for begin, end in pairwise([0, *changes.tolist(), table.num_rows]):
        key = tuple(str(each[begin].as_py()) for each in encoded)
        part = table.slice(begin, end - begin)
        known = found.get((key[0], key[1]))
        found[key[0], key[1]] = part if known is None else pa.concat_tables([known, part])
    return found


def _column(table: pa.Table, name: str) -> FloatArray:
    """A column with NaN for what is not there."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), np.float64)
