"""Columns of the experiments' tables that are not used and vary with what nothing explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.findings.words.numbers import readable_time
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.problem.tables.measured import UnusedColumns
from cluster_est.problem.variables import silent_inputs
from cluster_est.statistics.dependence import Dependence, dependence, periodic_share
from cluster_est.statistics.records import OutputRecord
from workers.messages import Experiment, FloatArray

MOST_COLUMNS = 200
"""Columns that are looked at; the first ones of the tables."""

MOST_NAMED = 3
"""Columns that are named."""

COPY = 0.9999
"""Correlation with something that is used from which on a column is a copy of it."""

PERIODIC = 0.5
"""Share of a column's variance, in every record, that makes a period its own."""

SWINGS = 3.0
"""Periods that a record must have for that."""


@dataclass(frozen=True)
class VaryingColumn:
    """A column that is not used and varies with a residual.

    Attributes
    ----------
    column, output
        Names of the column, and of the output whose residual it varies with.
    share
        Of the residual's variance that the column carries, at once and late.
    p
        The probability of as much by chance among all columns and outputs that were looked at; NaN
        where only the period is the same.
    period
        Seconds, where only that is the same; else NaN.
    silent
        Inputs of the FMU that nothing drives: it may belong there.
    """

    column: str
    output: str
    share: float
    p: float = np.nan
    period: float = np.nan
    silent: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Say what it has to do with the residual, and what to try."""
        name = f"column {self.column!r} is not used and"
        if np.isfinite(self.period):
            return f"{name} has the same period, {readable_time(self.period)}: {self._advice}"
        return (
            f"{name} varies with it (it carries {self.share:.0%} of the residual of {self.output}"
            f"): {self._advice}, unless it is a consequence itself"
        )

    @property
    def _advice(self) -> str:
        if not self.silent:
            return "try it as a signal"
        return f"try it as input {' or '.join(self.silent)}, which has no data, or as a signal"


def varying_columns(
    workbench: LoopWorkbench, residuals: FloatArray, period: float = np.nan
) -> tuple[VaryingColumn, ...]:
    """Name unused columns that vary with a residual, by more than chance; the surest first.

    Where there are none and the residual has a period, columns with the same one are named.

    Parameters
    ----------
    workbench
        Its problem knows the tables; experiments that were made in Python have none.
    residuals : (N,)
        Of the training experiments.
    period
        Of what is looked for, in seconds; NaN for none.
    """
    tables = _tables(workbench)
    names = _common(tables)
    if not names:
        return ()
    found = []
    count = len(names) * len(workbench.records.outputs)
    for output, label in enumerate(workbench.records.outputs):
        for name in names:
            seen = _dependence(_pairs(workbench, tables, residuals, output, name))
            p = min(seen.p * count, 1.0)
            if p <= workbench.settings.significance:
                found.append(VaryingColumn(name, label, seen.share, p))
    if not found and np.isfinite(period):
        found = [
            VaryingColumn(name, "", np.nan, period=period)
            for name in names
            if _has_period(workbench, tables, residuals, name, period)
        ]
    best: dict[str, VaryingColumn] = {}
    for each in sorted(found, key=lambda c: (np.nan_to_num(c.p), -np.nan_to_num(c.share))):
        best.setdefault(each.column, each)
    silent = silent_inputs(workbench.problem, workbench.description)
    return tuple(replace(each, silent=silent) for each in best.values())[:MOST_NAMED]


@dataclass(frozen=True)
class _Pair:
    """Residual and column of a record at even steps, and what is driven there."""

    residual: FloatArray
    column: FloatArray
    times: FloatArray
    driving: dict[str, FloatArray]


def _dependence(pairs: Sequence[_Pair]) -> Dependence:
    known = [pair.driving for pair in pairs]
    return dependence([(pair.residual, pair.column) for pair in pairs], known)


def _tables(workbench: LoopWorkbench) -> dict[int, UnusedColumns]:
    """Unused columns of the training experiments, by position; none if one has no table."""
    sources = {source.experiment: source for source in workbench.problem.tables}
    ids = [workbench.problem.experiments[e].record_id for e in workbench.train]
    if not all(name in sources for name in ids):
        return {}
    return {i: sources[name].unused() for i, name in enumerate(ids)}


def _common(tables: Mapping[int, UnusedColumns]) -> list[str]:
    """Columns that every table has, in the order of the first."""
    first = next(iter(tables.values()), None)
    if first is None:
        return []
    names = [n for n in first.values if all(n in each.values for each in tables.values())]
    return names[:MOST_COLUMNS]


def _pairs(
    workbench: LoopWorkbench,
    tables: Mapping[int, UnusedColumns],
    residuals: FloatArray,
    output: int,
    name: str,
) -> list[_Pair]:
    """Residual and column of each record of an output, at even steps.

    None where the column is missing in one of them, or is a copy of what is used.
    """
    records = [r for r in workbench.records.items if r.output == output and len(r.times) > 2]
    if not records:
        return []
    step = float(np.median(np.concatenate([np.diff(record.times) for record in records])))
    made = []
    for record in records:
        experiment = workbench.problem.experiments[workbench.train[record.experiment]]
        times = _even(record, step)
        x = tables[record.experiment].at(name, times)
        if x is None or _is_copy(x, times, experiment):
            return []
        y = np.interp(times, record.times, residuals[record.rows])
        given = (*experiment.inputs, *experiment.signals)
        driving = {each.variable: np.interp(times, each.times, each.values) for each in given}
        made.append(_Pair(y, x, times, driving))
    return made


def _even(record: OutputRecord, step: float) -> FloatArray:
    count = int((record.times[-1] - record.times[0]) / step + 1e-6) + 1
    return np.asarray(record.times[0] + step * np.arange(count))


def _is_copy(x: FloatArray, times: FloatArray, experiment: Experiment) -> bool:
    """Return whether a column says what an input, signal or output says already, or the time."""
    used = [(e.times, e.values) for e in (*experiment.inputs, *experiment.signals)]
    used += [(o.times, o.values) for o in experiment.outputs if len(o.times)]
    series = [times, *(np.interp(times, when, values) for when, values in used)]
    for other in series:
        if np.ptp(x) == 0.0 or np.ptp(other) == 0.0:
            continue
        if abs(float(np.corrcoef(x, other)[0, 1])) > COPY:
            return True
    return False


def _has_period(
    workbench: LoopWorkbench,
    tables: Mapping[int, UnusedColumns],
    residuals: FloatArray,
    name: str,
    period: float,
) -> bool:
    """Return whether most of a column is a wave of this period, in every record."""
    pairs = _pairs(workbench, tables, residuals, 0, name)
    long = [pair for pair in pairs if np.ptp(pair.times) >= SWINGS * period]
    shares = [periodic_share(pair.column, pair.times, period) for pair in long]
    return bool(long) and min(shares) >= PERIODIC
