"""The unexplained part of a residual: its size, its spectrum, and unused columns related to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import welch

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import SHORTEST_SPECTRUM
from cluster_est.problem.display import in_percent, plain_number, readable_time
from cluster_est.problem.tables.sources import UnusedColumns
from cluster_est.problem.variables import silent_inputs
from cluster_est.statistics.dependence import dependence, periodic_share
from cluster_est.statistics.records import OutputRecord
from workers.messages import Experiment, FloatArray

SHARE_OF_POWER = 0.9
"""Share of the power below the frequency that is reported."""

SLOW = 0.01
"""Frequency in Hz below which only the period is given."""

MOST_EVEN_STEPS = 2.0
"""Largest number of evenly spaced steps for each sample of a record. In a record with long gaps, or
with samples that are much rarer than in other records, interpolation would determine the
spectrum."""

NARROW = 0.5
"""Least share of the power in one peak for which its period is reported."""


@dataclass(frozen=True)
class UnexplainedResidual:
    """The part of an output's residual that neither the noise nor an effect explains.

    Attributes
    ----------
    output, unit
        Name and unit of the measured variable.
    size
        Root mean square in that unit, without the noise.
    over_noise
        `size` divided by the standard deviation of the noise; NaN if there is no noise.
    shortest_period
        Nine tenths of its power have periods above this value, in seconds; NaN if the records are
        too short.
    period
        Period in seconds of a single oscillation with more than half of the power; NaN if there is
        none.
    columns
        Sentences on unused columns of the tables that are related to it.
    """

    output: str
    unit: str
    size: float
    over_noise: float
    shortest_period: float = np.nan
    period: float = np.nan
    columns: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Give its size and its periods, as the change of an output."""
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        said = f"output {self.output} by {plain_number(self.size, 3)}{unit} rms"
        if np.isfinite(self.period):
            return f"{said}, mostly with a period of {readable_time(self.period)}"
        if np.isfinite(self.shortest_period):
            shortest = readable_time(self.shortest_period)
            fastest = 1.0 / self.shortest_period
            below = f" (frequencies below {fastest:.3g} Hz)" if fastest >= SLOW else ""
            power = f"{SHARE_OF_POWER:.0%} of the power of this change"
            return f"{said}, with {power} at periods above {shortest}{below}"
        return said


def unexplained_residuals(
    fitter: Fitter, fitted: FittedModel, noise: FloatArray
) -> tuple[UnexplainedResidual, ...]:
    """Describe each output's residual beyond its noise, (outputs,); the largest first."""
    records, sigmas = fitter.records, fitter.sigmas
    found = []
    for number, name in enumerate(records.outputs):
        own = [item for item in records.items if item.output == number]
        rows = records.of_output(number)
        part, level = fitted.residuals[rows], float(np.nan_to_num(noise[number]))
        square = float(np.mean(part**2)) if len(part) else 0.0
        if not square > level**2:
            continue
        beyond = float(np.sqrt(square - level**2))
        # in the unit of the output; sigma may differ between experiments
        size = float(np.sqrt(np.mean((part * sigmas[rows]) ** 2) * (1.0 - level**2 / square)))
        variable = fitter.description.variables.get(name)
        shortest, period = _periods(fitted.residuals, own, level)
        found.append(
            UnexplainedResidual(
                output=name,
                unit=variable.unit if variable is not None else "",
                size=size,
                over_noise=beyond / level if level > 0.0 else np.nan,
                shortest_period=shortest,
                period=period,
            )
        )
    return tuple(sorted(found, key=lambda each: -np.nan_to_num(each.over_noise, nan=np.inf)))


def _periods(
    residuals: FloatArray, records: Sequence[OutputRecord], noise: float
) -> tuple[float, float]:
    """Return the shortest period of most of the power, and the period of a single peak, or NaN.

    The power is computed by Welch's method, doi:10.1109/TAU.1967.1161901, minus white noise.
    """
    long = [item for item in records if len(item.times) >= SHORTEST_SPECTRUM]
    if not long:
        return np.nan, np.nan
    step = _usual_step(long)
    pairs = [(record, _even_times(record, step)) for record in long]
    even = [
        (record, times)
        for record, times in pairs
        if SHORTEST_SPECTRUM <= len(times) <= MOST_EVEN_STEPS * len(record.times)
    ]
    if not even:
        return np.nan, np.nan
    length = min(len(times) for _, times in even)
    total = np.zeros(length // 2 + 1)
    for item, times in even:
        signal = np.interp(times, item.times, residuals[item.rows])
        frequencies, density = welch(signal, 1.0 / step, nperseg=length, detrend=False)
        total += len(item.times) * density
    total /= sum(len(item.times) for item, _ in even)
    power = np.maximum(total - 2.0 * noise**2 * step, 0.0)
    if not power.sum() > 0.0:
        return np.nan, np.nan
    shares = power / power.sum()
    fast = frequencies[
        min(int(np.searchsorted(np.cumsum(shares), SHARE_OF_POWER)), len(shares) - 1)
    ]
    peak = int(np.argmax(shares))
    around = shares[max(peak - 1, 0) : peak + 2].sum()
    narrow = peak >= 3 and around >= NARROW  # at least three periods in a record
    return (
        float(1.0 / fast) if fast > 0.0 else np.nan,
        float(1.0 / frequencies[peak]) if narrow else np.nan,
    )


def _usual_step(records: Sequence[OutputRecord]) -> float:
    return float(np.median(np.concatenate([np.diff(record.times) for record in records])))


def _even_times(record: OutputRecord, step: float) -> FloatArray:
    """Return evenly spaced times over a record."""
    count = int((record.times[-1] - record.times[0]) / step + 1e-6) + 1
    return np.asarray(record.times[0] + step * np.arange(count))


MOST_COLUMNS = 200
"""Largest number of columns that are tested: the first ones of the tables."""

MOST_NAMED_COLUMNS = 3
"""Largest number of columns that are reported."""

COPY = 0.9999
"""If a column's correlation with a used signal is above this value, it is a copy of this signal."""

PERIODIC = 0.5
"""A column has a period if an oscillation with this period has this share of its variance in every
record."""

SWINGS = 3.0
"""Least number of such periods in a record."""


@dataclass(frozen=True)
class VaryingColumn:
    """An unused column of a table that is related to a residual.

    Attributes
    ----------
    share
        Share of the variance of the output's residual that the column explains, with and without
        a delay.
    p
        Probability of such a share by chance, among all columns and outputs that were tested; NaN
        if only the period is the same.
    period
        Period in seconds, if only the period is the same as that of the residual; otherwise NaN.
    silent
        Inputs of the FMU without data. The column may be the data of one of them.
    """

    column: str
    output: str
    share: float
    p: float = np.nan
    period: float = np.nan
    silent: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Say how it is related to the residual, and what to try."""
        name = f"the unused column {self.column!r}"
        if np.isfinite(self.period):
            period = readable_time(self.period)
            return f"{name} has the same period as the residual, {period}: {self._advice}"
        return (
            f"{name} explains {in_percent(self.share)} of the residual of {self.output}: "
            f"{self._advice}, unless the column is itself a consequence of the output"
        )

    @property
    def _advice(self) -> str:
        if not self.silent:
            return "try the column as a signal"
        return f"try the column as data of the input {' or '.join(self.silent)}, or as a signal"


def varying_columns(
    fitter: Fitter, residuals: FloatArray, significance: float, period: float = np.nan
) -> tuple[VaryingColumn, ...]:
    """Return unused columns that are significantly related to a residual, the surest first.

    Their p-values, corrected for all columns and outputs, are at most `significance`. If there are
    no such columns and the residual has a `period`, in seconds, the columns with the same period
    are returned.
    """
    tables = _tables(fitter)
    names = _common(tables)
    if not names:
        return ()
    found = []
    count = len(names) * len(fitter.records.outputs)
    for output, label in enumerate(fitter.records.outputs):
        for name in names:
            pairs = _pairs(fitter, tables, residuals, output, name)
            series = [(pair.residual, pair.column) for pair in pairs]
            seen = dependence(series, [pair.driving for pair in pairs])
            p = min(seen.p * count, 1.0)
            if p <= significance:
                found.append(VaryingColumn(name, label, seen.share, p))
    if not found and np.isfinite(period):
        found = [
            VaryingColumn(name, "", np.nan, period=period)
            for name in names
            if _has_period(_pairs(fitter, tables, residuals, 0, name), period)
        ]
    best: dict[str, VaryingColumn] = {}
    for each in sorted(found, key=lambda c: (np.nan_to_num(c.p), -np.nan_to_num(c.share))):
        best.setdefault(each.column, each)
    silent = silent_inputs(fitter.problem, fitter.description)
    return tuple(replace(each, silent=silent) for each in best.values())[:MOST_NAMED_COLUMNS]


@dataclass(frozen=True)
class _Pair:
    """Residual, column and inputs of a record at evenly spaced times."""

    residual: FloatArray
    column: FloatArray
    times: FloatArray
    driving: dict[str, FloatArray]


def _tables(fitter: Fitter) -> list[UnusedColumns]:
    """Return the unused columns of each training experiment; none if one has no table."""
    sources = {source.experiment: source for source in fitter.problem.tables}
    ids = [run.record_id for run in fitter.runs]
    return [sources[name].unused() for name in ids] if all(n in sources for n in ids) else []


def _common(tables: Sequence[UnusedColumns]) -> list[str]:
    """Return the columns that every table has, in the order of the first table."""
    first = tables[0].values if tables else ()
    return [n for n in first if all(n in each.values for each in tables)][:MOST_COLUMNS]


def _pairs(
    fitter: Fitter,
    tables: Sequence[UnusedColumns],
    residuals: FloatArray,
    output: int,
    name: str,
) -> list[_Pair]:
    """Return the residual and the column in each record of an output, at evenly spaced times.

    Empty if the column is missing in one of the records, or is a copy of a used signal.
    """
    records = [r for r in fitter.records.items if r.output == output and len(r.times) > 2]
    if not records:
        return []
    step = _usual_step(records)
    made = []
    for record in records:
        experiment = fitter.runs[record.experiment]
        times = _even_times(record, step)
        x = tables[record.experiment].at(name, times)
        if x is None or _is_copy(x, times, experiment):
            return []
        y = np.interp(times, record.times, residuals[record.rows])
        given = (*experiment.inputs, *experiment.signals)
        driving = {each.variable: np.interp(times, each.times, each.values) for each in given}
        made.append(_Pair(y, x, times, driving))
    return made


def _is_copy(x: FloatArray, times: FloatArray, experiment: Experiment) -> bool:
    """Return whether a column is a copy of an input, a signal, an output or the time."""
    used = [(e.times, e.values) for e in (*experiment.inputs, *experiment.signals)]
    used += [(o.times, o.values) for o in experiment.outputs if len(o.times)]
    series = [times, *(np.interp(times, when, values) for when, values in used)]
    moving = [other for other in series if np.ptp(x) > 0.0 and np.ptp(other) > 0.0]
    return any(abs(float(np.corrcoef(x, other)[0, 1])) > COPY for other in moving)


def _has_period(pairs: Sequence[_Pair], period: float) -> bool:
    """Return whether most of a column is an oscillation with this period, in every record."""
    long = [pair for pair in pairs if np.ptp(pair.times) >= SWINGS * period]
    shares = [periodic_share(pair.column, pair.times, period) for pair in long]
    return bool(long) and min(shares) >= PERIODIC
