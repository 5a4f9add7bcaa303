"""Residuals of each output: whether they are white noise, and otherwise on what they depend.

The section combines all training experiments. White noise has no autocorrelation, is normally
distributed, and has a mean of 0 at any time and for any value of the inputs and the output.
"""

from __future__ import annotations

import numpy as np

from cluster_est.html_report.charts import (
    Bars,
    Chart,
    Dots,
    ErrorBars,
    Line,
    Mark,
    Plot,
    Rules,
)
from cluster_est.html_report.number_text import percent
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    GridBlock,
    ReportSection,
    TextBlock,
    with_unit,
)
from cluster_est.html_report.recorded_curves import OutputCurves
from cluster_est.html_report.reported_run import ReportedRun
from cluster_est.html_report.scales import Scale
from cluster_est.statistics.residual_tests import lagged_products
from workers.effects.units import per_second
from workers.messages import FloatArray

MOST_OUTPUTS = 4
"""Largest number of outputs in the section: those with the largest residuals over their noise."""
FEWEST_SAMPLES = 20
MOST_LAGS, FEWEST_LAGS = 2000, 20
DRAWN_LAGS = 100
MOST_DOTS, MEANS, BINS = 300, 16, 30
"""Numbers of samples drawn over a variable, of their means, and of bars of a histogram."""
MOST_VARIABLES = 4
"""Number of inputs over which residuals are drawn, and of states, by decreasing dependence."""
ALIKE = 0.9999
"""Correlation with the output, its rate or an input above which a state is not drawn."""
COVERED = 1.96
HEIGHT = 130
NOTE = (
    "The plots combine all training experiments. The residuals of a complete model are white "
    "noise: about 95 % of the autocorrelations lie between the dashed lines, the histogram follows "
    "the curve, and the means are close to 0 over the whole range of every variable. If the means "
    "bend over a variable, this variable is a hint at what is missing. The error bars are 95 % "
    "intervals of the means; if neighbouring samples are correlated, these intervals are too "
    "narrow."
)


def residuals(run: ReportedRun) -> ReportSection:
    """Return autocorrelation, histogram, and residuals over time and other variables."""
    outputs: dict[str, list[OutputCurves]] = {}
    for (_, output), each in run.curves.items():
        known = np.isfinite(each.measured - each.after).sum()
        if each.role == "train" and each.has_times and known >= FEWEST_SAMPLES:
            outputs.setdefault(output, []).append(each)
    ranked = sorted(outputs, key=lambda name: -_size(outputs[name]))[:MOST_OUTPUTS]
    units = {row["output"]: row["unit"] for row in run.tables["errors"]}
    blocks: list[Block] = [TextBlock(NOTE)] if ranked else []
    for number, name in enumerate(ranked):
        if len(ranked) > 1:
            blocks.append(TextBlock(name, kind="heading"))
        blocks += _output(f"residual-{number}", name, units.get(name, ""), outputs[name])
    if len(outputs) > len(ranked) > 0:
        blocks.append(TextBlock(f"{len(ranked)} of {len(outputs)} outputs are shown.", "faint"))
    return ReportSection("residuals", "Residuals", tuple(blocks))


def _size(records: list[OutputCurves]) -> float:
    """Return the root mean square of the residuals, in units of sigma."""
    joined = np.concatenate([each.residual for each in records])
    return float(np.sqrt(np.nanmean(joined**2)))


def _output(id_: str, name: str, unit: str, records: list[OutputCurves]) -> list[Block]:
    rest = [each.measured - each.after for each in records]
    label = with_unit("residual", unit)
    known = _variables(name, unit, records)
    known += _states(records, rest, known)
    over = [_over(f"{id_}-{i}", *each, rest, label) for i, each in enumerate(known)]
    drawn = [each for each in over if each is not None]
    lags = _autocorrelation(f"{id_}-lags", rest, records)
    return [GridBlock((*lags, _histogram(f"{id_}-histogram", rest, label), *drawn))]


def _autocorrelation(
    id_: str, rest: list[FloatArray], records: list[OutputCurves]
) -> list[FigureBlock]:
    """Return the autocorrelation of a residual, up to a multiple of its correlation length."""
    parts = [np.nan_to_num(each) for each in rest]
    sums = lagged_products(parts)
    samples = sum(map(len, parts))
    if len(sums) < 3 or not sums[0] > 0.0:
        return []
    rho = sums[1 : 1 + min(MOST_LAGS, len(sums) // 2)] / sums[0]
    limit = COVERED / np.sqrt(samples)
    inside = np.flatnonzero(np.abs(rho) < limit)
    shown = max(FEWEST_LAGS, 4 * int(inside[0] + 1) if len(inside) else len(rho))
    rho = rho[:shown]
    outside = float(np.mean(np.abs(rho) > limit))
    step = float(np.median(np.concatenate([np.diff(each.time) for each in records])))
    kept = np.unique(np.linspace(0, len(rho) - 1, min(len(rho), DRAWN_LAGS)).astype(int))
    lag = step * (kept + 1.0)
    marks: list[Mark] = [
        Rules("", "faint", y=(-limit, 0.0, limit)),
        ErrorBars("", "after", lag, np.zeros(len(lag)), rho[kept]),
        Dots("autocorrelation", "after", lag, rho[kept]),
    ]
    y = Scale.around(rho, np.array([-2.0 * limit, 2.0 * limit, 0.0]))
    title = f"Autocorrelation: {percent(outside)} of {len(rho)} lags beyond the dashed lines"
    plot = Plot(title, "correlation", Scale.around(lag, np.zeros(1)), y, marks, HEIGHT)
    return [FigureBlock(id_, title, Chart((plot,), "lag (s)", legend=False, across=4))]


def _histogram(id_: str, rest: list[FloatArray], label: str) -> FigureBlock:
    """Return the histogram of residuals with a normal distribution of the same spread."""
    values = np.concatenate(rest)
    values = values[np.isfinite(values)]
    spread = float(np.sqrt(np.mean(values**2))) or 1.0
    reach = float(np.clip(np.abs(values).max() / spread, 3.0, 6.0)) * spread
    counts, edges = np.histogram(np.clip(values, -reach, reach), BINS, (-reach, reach))
    heights = counts / (len(values) * (edges[1] - edges[0])) * spread
    across = np.linspace(-reach, reach, 121)
    normal = np.exp(-0.5 * (across / spread) ** 2) / np.sqrt(2.0 * np.pi)
    marks: list[Mark] = [
        Bars("residuals", "after", edges, heights),
        Line("normal distribution", "before", across, normal),
    ]
    y = Scale(0.0, 1.08 * float(max(heights.max(), normal.max())))
    title = "Histogram, compared with a normal distribution"
    plot = Plot(title, "density x rms", Scale.around(edges, margin=0.0), y, marks, HEIGHT)
    return FigureBlock(id_, title, Chart((plot,), label, legend=False, across=4))


Variable = tuple[str, str, list[FloatArray]]
"""Name and unit of a variable, and its values at the residuals of each record."""


def _variables(name: str, unit: str, records: list[OutputCurves]) -> list[Variable]:
    """Return the time, the output, its rate, and each input that all records have."""
    rates = [_rate(each) for each in records]
    found: list[Variable] = [
        ("time", "time (s)", [each.time for each in records]),
        (f"simulated {name}", with_unit(f"simulated {name}", unit), [e.after for e in records]),
        (f"rate of {name}", with_unit(f"rate of {name}", per_second(unit) if unit else ""), rates),
    ]
    inputs = [{given.name: given for given in each.inputs} for each in records]
    for given in list(inputs[0].values())[:MOST_VARIABLES]:
        if all(given.name in each for each in inputs):
            values = [
                np.interp(record.time, each[given.name].time, each[given.name].value)
                for record, each in zip(records, inputs, strict=True)
            ]
            label = with_unit(f"input {given.name}", given.unit)
            found.append((f"input {given.name}", label, values))
    return found


def _states(
    records: list[OutputCurves], rest: list[FloatArray], others: list[Variable]
) -> list[Variable]:
    """Return the states on which residuals depend most, unless equivalent to another variable."""
    up, found = np.concatenate(rest), []
    known = [np.concatenate(values) for _, _, values in others]
    for name, unit in {s.name: s.unit for each in records for s in each.states}.items():
        values = [_at_times(each, name) for each in records]
        across = np.concatenate(values)
        if any(_alike(across, each) for each in known):
            continue
        known.append(across)
        label = with_unit(f"state {name}", unit)
        found.append((_bend(across, up), (f"state {name}", label, values)))
    found.sort(key=lambda each: -each[0])
    return [variable for _, variable in found[:MOST_VARIABLES]]


def _at_times(record: OutputCurves, name: str) -> FloatArray:
    """Return a state at the measured times; NaN if it was not stored."""
    for state in record.states:
        if state.name == name:
            at = np.searchsorted(state.time, record.time).clip(max=len(state.time) - 1)
            return np.where(state.time[at] == record.time, state.value[at], np.nan)
    return np.full(len(record.time), np.nan)


def _alike(one: FloatArray, other: FloatArray) -> bool:
    both = np.isfinite(one) & np.isfinite(other)
    if both.sum() < FEWEST_SAMPLES or not np.ptp(one[both]) > 0.0 or not np.ptp(other[both]) > 0.0:
        return False
    return bool(abs(np.corrcoef(one[both], other[both])[0, 1]) > ALIKE)


def _bend(across: FloatArray, up: FloatArray) -> float:
    """Return the share of the sum of squares explained by the means over a variable."""
    known = np.isfinite(across) & np.isfinite(up)
    across, up = across[known], up[known]
    total = float(np.sum(up**2))
    parts = np.array_split(up[np.argsort(across, kind="stable")], MEANS)
    explained = sum(len(each) * float(np.mean(each)) ** 2 for each in parts if len(each))
    return explained / total if total > 0.0 else 0.0


def _rate(each: OutputCurves) -> FloatArray:
    """Return the rate of change of the simulated output at the measured times."""
    time, after = (each.time, each.after) if each.fine is None else each.fine[:2]
    time, first = np.unique(time, return_index=True)
    if len(time) < 3:
        return np.full(len(each.time), np.nan)
    return np.interp(each.time, time, np.gradient(after[first], time))


def _over(
    id_: str, name: str, below: str, x: list[FloatArray], rest: list[FloatArray], label: str
) -> FigureBlock | None:
    """Return residuals over a variable: some dots, and means of all; None if it is constant."""
    across, up = np.concatenate(x), np.concatenate(rest)
    known = np.isfinite(across) & np.isfinite(up)
    across, up = across[known], up[known]
    if len(across) < FEWEST_SAMPLES or not np.ptp(across) > 0.0:
        return None
    order = np.argsort(across, kind="stable")
    parts = [each for each in np.array_split(order, MEANS) if len(each) > 1]
    middle, mean = (np.array([v[each].mean() for each in parts]) for v in (across, up))
    error = np.array([up[each].std() / np.sqrt(len(each)) for each in parts])
    some = np.unique(np.linspace(0, len(order) - 1, MOST_DOTS).astype(int))
    marks: list[Mark] = [
        Dots("residual", "faint", across[some], up[some]),
        Rules("", "faint", y=(0.0,)),
        ErrorBars("", "after", middle, mean - COVERED * error, mean + COVERED * error),
        Line("mean", "after", middle, mean),
    ]
    title = f"Over {name}"
    plot = Plot(title, label, Scale.around(across), Scale.around(up[some], mean), marks, HEIGHT)
    return FigureBlock(id_, title, Chart((plot,), below, legend=False, across=4))
