"""Curves of every experiment: inputs, measured and simulated outputs, and residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cluster_est.html_report.charts import (
    Band,
    Chart,
    Dots,
    Line,
    Mark,
    Plot,
    Rules,
)
from cluster_est.html_report.error_sections import error_sizes
from cluster_est.html_report.full_records import FullRecord, full_records
from cluster_est.html_report.number_text import TimeUnit, count, time_unit
from cluster_est.html_report.page_blocks import (
    CurvePanel,
    FigureBlock,
    PanelsBlock,
    ReportSection,
    TextBlock,
    with_unit,
)
from cluster_est.html_report.recorded_curves import Key, OutputCurves, SignalCurve
from cluster_est.html_report.reported_run import ReportedRun
from cluster_est.html_report.scales import Scale
from cluster_est.problem.tables.gaps import long_steps
from workers.messages import FloatArray, IntArray


def extremes(x: FloatArray, y: FloatArray, columns: int) -> IntArray:
    """Return indices into a curve that preserve its appearance in a number of columns.

    The range of x is divided into columns of equal width. In each column, the samples with the
    lowest and the highest y are kept, and the first and last sample of all. If a column is one
    pixel wide, only samples hidden by others are omitted.

    Parameters
    ----------
    x : (n,)
        Finite, in any order; it is drawn in the order of the samples.
    y : (n,)
        A NaN counts as no sample. Ends of gaps are kept, so that gaps remain visible, unless there
        are more of them than columns.
    columns
        Number of columns of the plot.

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
    """Return the column of each sample, from 0 on."""
    low, span = float(x.min()), float(np.ptp(x)) or 1.0
    return np.minimum(((x - low) / span * columns).astype(np.int64), columns - 1)


MOST_CURVE_POINTS = 80_000
"""Largest number of points of all curves together; each takes about 7 bytes in the page."""
FEWEST_COLUMNS_OF_CHART, MOST_COLUMNS_OF_CHART = 20, 600
"""Limits of the number of columns of a chart; a column has two samples of each curve."""
MOST_CURVE_PANELS = 250
MOST_INPUTS = 3
"""Largest number of inputs that are drawn above an output."""
FEW_SAMPLES = 150
"""Largest number of measured values that are drawn as dots."""
CURVES = (("measured", "measured"), ("before", "before"), ("after", "after"))
"""Names and inks of the curves."""
INPUT_HEIGHT, HEIGHT, RESIDUAL_HEIGHT = 44, 170, 84
LEAD_HEIGHT, LEAD_RESIDUAL_HEIGHT = 180, 90
"""Heights of the output and the residual in charts at the head of the page."""
MOST_BEFORE = 3.0
"""Largest height of the curve before the fit, relative to the other curves; the rest is cut off."""
LIMITS_OF_NOISE = 2.0
"""Distance of the dashed lines from 0 in a plot of residuals, relative to the noise."""
RESIDUAL = "residual"


@dataclass(frozen=True)
class _Across:
    """Common properties of a chart's plots: scale of the time, its unit in seconds, columns."""

    x: Scale
    seconds: float
    columns: int


class RecordCharts:
    """Makes the charts of a run, all with the same unit of time.

    Parameters
    ----------
    run
        A run with curves.
    """

    def __init__(self, run: ReportedRun) -> None:
        self._known = run.curves
        self._sizes = error_sizes(run)
        self._rows = {(r["experiment"], r["output"]): i for i, r in enumerate(self._sizes.rows)}
        self._unit = time_unit(max((each.span for each in self._known.values()), default=0.0))

    @cached_property
    def shown(self) -> list[Key]:
        """The records with a chart: those with the largest errors, in their original order."""
        kept = set(self.ranked()[:MOST_CURVE_PANELS])
        return [key for key in self._known if key in kept]

    @cached_property
    def columns(self) -> int:
        """Number of columns of each chart."""
        points = sum(10 + 4 * len(self._known[key].inputs[:MOST_INPUTS]) for key in self.shown)
        columns = MOST_CURVE_POINTS / max(points, 1)
        return int(np.clip(columns, FEWEST_COLUMNS_OF_CHART, MOST_COLUMNS_OF_CHART))

    def ranked(self, role: str = "") -> list[Key]:
        """Return the records of a role, sorted by decreasing relative error."""
        own = [key for key, each in self._known.items() if role in ("", each.role)]
        return sorted(own, key=lambda key: -self._size(key))

    def _size(self, key: Key) -> float:
        """Return the relative error of a record; -1 if unknown."""
        row = self._rows.get(key)
        size = math.nan if row is None else self._sizes.of([row], "after")
        return -1.0 if math.isnan(size) else size

    def full(self) -> dict[str, FullRecord]:
        """Return all samples of records that are thinned in their charts, as far as they fit."""
        long = [key for key in self.ranked() if self._is_thinned(key)]
        heads = [found[0] for role in ("train", "test") if (found := self.ranked(role))]
        order = [*(key for key in heads if key in long), *(key for key in long if key not in heads)]
        known = {_name(key): _without_lines(self._known[key], self._unit) for key in order}
        return full_records(known, known)

    def _is_thinned(self, key: Key) -> bool:
        each = self._known[key]
        return each.has_times and len(each.measured) > 2 * self.columns + 2

    def note(self, key: Key) -> str:
        """Return the role of a record and its error, in the unit of the output and relative."""
        row = self._rows.get(key)
        held_out = self._known[key].role == "test"
        return ("held out, " if held_out else "") + ("" if row is None else self._sizes.said([row]))

    def chart(self, key: Key, *, lead: bool = False) -> Chart:
        """Return the chart of a record: its inputs, the output, and the residual."""
        each, row = self._known[key], self._rows.get(key)
        name, unit = (
            " of ".join(reversed(key)),
            "" if row is None else self._sizes.rows[row]["unit"],
        )
        if not each.has_times:
            return _distances(name, each, self.columns)
        heights = (LEAD_HEIGHT, LEAD_RESIDUAL_HEIGHT) if lead else (HEIGHT, RESIDUAL_HEIGHT)
        seconds = self._unit.seconds
        x = Scale.around(each.time / seconds, (each.fine or (each.time,))[0] / seconds, margin=0.0)
        across = _Across(x, seconds, self.columns)
        inputs = [_input(given, across) for given in each.inputs[:MOST_INPUTS]]
        output = Plot(
            f"{name}: measured and simulated over time",
            with_unit(key[1], unit),
            x,
            _upright(each),
            _upper(each, across),
            heights[0],
        )
        noise = math.nan if row is None else self._sizes.noise(row)
        residual = _residual(name, each, across, unit, noise, heights[1])
        record = _name(key) if self._is_thinned(key) else ""
        below = f"time ({self._unit.name})"
        return Chart((*inputs, output, residual), below, lead, 5, record=record)


def _name(key: Key) -> str:
    """Return the name of a record on the page."""
    return " ".join(key)


def lead_figures(charts: RecordCharts) -> list[FigureBlock]:
    """Return the training record and the held-out record with the largest errors."""
    found = []
    for role, id_, one, worst in (
        ("train", "worst", "The training record", "The worst training record"),
        ("test", "held-out", "The held-out record", "The worst held-out record"),
    ):
        keys = charts.ranked(role)
        if keys:
            called = one if len(keys) == 1 else worst
            said = charts.note(keys[0]).removeprefix("held out, ")
            title = f"{called}: {', '.join(keys[0])}{f'; {said}' if said else ''}"
            found.append(FigureBlock(id_, title, charts.chart(keys[0], lead=True)))
    return found


def curves(run: ReportedRun, charts: RecordCharts, full: Sequence[str]) -> ReportSection:
    """Return the section with every output of every experiment as a small chart.

    Parameters
    ----------
    run, charts
        The run, and the object that makes its charts.
    full
        Names of the records whose samples are all in the page.
    """
    if not run.curves:
        return ReportSection("curves", "Curves", ())
    panels = [CurvePanel(*key, charts.note(key), charts.chart(key)) for key in charts.shown]
    known = run.curves.values()
    inks = tuple(e for e in CURVES if any(np.isfinite(getattr(c, e[0])).any() for c in known))
    blocks = TextBlock(_how(run, charts, len(full))), PanelsBlock(tuple(panels), inks)
    return ReportSection("curves", "Measured and simulated", blocks)


def _how(run: ReportedRun, charts: RecordCharts, full: int) -> str:
    """Return a text about what is drawn and what is omitted."""
    known, shown, columns = run.curves, charts.shown, charts.columns
    said = (
        f"Before: {run.before}. The lowest plot of each chart shows measured minus simulated "
        f"values (after), on its own scale; the dashed lines mark {LIMITS_OF_NOISE:g} times the "
        "noise."
    )
    long = sum(len(each.measured) > 2 * columns + 2 for each in known.values())
    if long:
        samples = sum(len(each.measured) for each in known.values())
        said += (
            f" There are {count(samples)} measured values. A chart is divided into {columns} "
            "columns; each shows the lowest and the highest of its values, so that no peak is "
            "lost. "
        )
        of = "all long records" if full == long else f"{full} of the {long} long records"
        said += (
            f"If you zoom in, the charts of {of} show every sample."
            if full
            else "The other samples are not shown, even if you zoom in."
        )
        said += (
            " The file residuals.parquet in the run's folder has all samples."
            if full < long
            else ""
        )
    else:
        said += " Every sample is drawn."
    if any(each.band is not None for each in known.values()):
        said += (
            " The shaded band shows the output for parameter values from the posterior; it does "
            "not include measurement noise."
        )
    most = max(len(each.inputs) for each in known.values())
    if most > MOST_INPUTS:
        said += (
            f" If more than {MOST_INPUTS} inputs change (here up to {most}), {MOST_INPUTS} of "
            "them are drawn."
        )
    if len(shown) < len(known):
        said += (
            f" Of {count(len(known))} charts, the {len(shown)} with the largest errors are drawn."
        )
    return said


def _input(given: SignalCurve, across: _Across) -> Plot:
    """Return the plot of an input, above the output."""
    time, x = given.time / across.seconds, across.x
    inside = np.flatnonzero((time >= x.low) & (time <= x.high))
    rows = slice(*(inside[[0, -1]] + [0, 1])) if len(inside) else slice(0, None)
    line = replace(_line(given.name, time[rows], given.value[rows], across.columns), ink="series-2")
    title = f"input {given.name} over time"
    label = with_unit(given.name, given.unit)
    return Plot(title, label, x, Scale.around(line.y, margin=0.1), [line], INPUT_HEIGHT)


def _upright(each: OutputCurves) -> Scale:
    """Return the scale of an output: measured, simulated and, unless far off, before the fit.

    Values outside the scale are cut off.
    """
    after = each.after if each.fine is None else each.fine[1]
    before = each.before if each.fine is None else each.fine[2]
    own = [each.measured, after, *(each.band or ())]
    usual, all_ = Scale.around(*own), Scale.around(*own, before)
    room = MOST_BEFORE * (usual.high - usual.low)
    if all_.high - all_.low <= room or not np.isfinite(after).any():
        return all_
    middle = 0.5 * (usual.low + usual.high)
    return Scale(max(all_.low, middle - 0.5 * room), min(all_.high, middle + 0.5 * room))


def _upper(each: OutputCurves, across: _Across) -> list[Mark]:
    """Return the marks of measured and simulated values."""
    seconds, columns = across.seconds, across.columns
    time = each.time / seconds
    marks: list[Mark] = [] if each.band is None else [_band(time, each.band, columns)]
    few = len(time) <= FEW_SAMPLES
    measured = Dots("measured", "measured", time, each.measured)
    marks.append(measured if few else broken_line("measured", time, each.measured, columns))
    fine_time, fine_after, fine_before = each.fine or (each.time, each.after, each.before)
    for label, curve in (("before", fine_before), ("after", fine_after)):
        if np.isfinite(curve).any():
            marks.append(broken_line(label, fine_time / seconds, curve, columns))
    return marks


def _residual(
    name: str, each: OutputCurves, across: _Across, unit: str, noise: float, height: int
) -> Plot:
    """Return the plot of the residual with its own scale, with lines at twice the noise."""
    label, curve = (
        ("after", each.after) if np.isfinite(each.after).any() else ("before", each.before)
    )
    rest = each.measured - curve
    limits = [LIMITS_OF_NOISE * noise * sign for sign in (-1.0, 1.0)] if noise > 0.0 else []
    upright = Scale.around(rest, np.zeros(1), np.array(limits))
    marks: list[Mark] = [Rules("", "faint", y=(0.0, *limits))]
    if np.isfinite(rest).any():
        marks.append(broken_line(label, each.time / across.seconds, rest, across.columns))
    title = f"{name}: measured minus simulated over time"
    return Plot(title, with_unit(RESIDUAL, unit), across.x, upright, marks, height, called=RESIDUAL)


def _band(time: FloatArray, band: tuple[FloatArray, FloatArray], columns: int) -> Band:
    """Return the band at some evenly spaced measured times, because it is smooth."""
    kept = np.unique(np.linspace(0, len(time) - 1, min(len(time), columns)).astype(int))
    return Band("posterior", "after", time[kept], band[0][kept], band[1][kept])


def _distances(name: str, each: OutputCurves, columns: int) -> Chart:
    """Return a chart of the distance of each segment of a curve from the simulation."""
    segment = np.arange(len(each.residual), dtype=float)
    plot = Plot(
        f"{name}: distance of each segment from the simulated curve",
        "distance, relative",
        Scale.around(segment, margin=0.0),
        Scale.around(each.residual, np.zeros(1)),
        [broken_line("after", segment, each.residual, columns)],
        HEIGHT + RESIDUAL_HEIGHT,
    )
    return Chart((plot,), "segment", legend=False, across=5)


def broken_line(name: str, x: FloatArray, y: FloatArray, columns: int) -> Line:
    """Return a line through samples, but not across gaps between them."""
    x, (y,) = _broken(x, y)
    return _line(name, x, y, columns)


def _line(name: str, x: FloatArray, y: FloatArray, columns: int) -> Line:
    kept = extremes(x, y, columns)
    return Line(name, name, x[kept], y[kept])


def _broken(x: FloatArray, *ys: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Insert a sample without a value into each gap between samples."""
    gaps = long_steps(x)
    behind = np.searchsorted(x, gaps[:, 1])
    return np.insert(x, behind, gaps.mean(axis=1)), [np.insert(y, behind, np.nan) for y in ys]


def _without_lines(each: OutputCurves, unit: TimeUnit) -> OutputCurves:
    """Return a record in a unit of time, with a sample without values in each gap."""
    curves = each.measured, each.after, each.before
    time, (measured, after, before) = _broken(each.time / unit.seconds, *curves)
    return replace(each, time=time, measured=measured, after=after, before=before)
