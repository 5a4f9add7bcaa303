"""Measured, simulated and input signals of each output of each experiment of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from workers.messages import FloatArray

Key = tuple[str, str]
"""An experiment and one of its outputs."""


@dataclass(frozen=True)
class SignalCurve:
    """An input or a state of an experiment, piecewise linear between samples, including steps."""

    name: str
    unit: str
    time: FloatArray = field(repr=False)
    value: FloatArray = field(repr=False)


@dataclass(frozen=True)
class OutputCurves:
    """One output of one experiment, measured and simulated at the measured times.

    `before` is NaN if unknown. `fine` contains the simulated curves with their own times: time,
    after and before. `band` contains limits of the output from the posterior. `inputs` are the
    non-constant inputs of the experiment, and `states` those of the model, if known.
    """

    role: str
    time: FloatArray = field(repr=False)
    measured: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)
    fine: tuple[FloatArray, FloatArray, FloatArray] | None = field(default=None, repr=False)
    band: tuple[FloatArray, FloatArray] | None = field(default=None, repr=False)
    inputs: tuple[SignalCurve, ...] = field(default=(), repr=False)
    states: tuple[SignalCurve, ...] = field(default=(), repr=False)

    @property
    def span(self) -> float:
        """Seconds from the first to the last measured time."""
        known = self.time[np.isfinite(self.time)]
        return float(np.ptp(known)) if len(known) else 0.0

    @property
    def has_times(self) -> bool:
        """Whether there are times; points of a curve have none."""
        return bool(np.isfinite(self.time).any())


def recorded_curves(
    tables: Mapping[str, pa.Table | None], experiment: str | None = None
) -> dict[Key, OutputCurves]:
    """Read the curves of a run.

    Parameters
    ----------
    tables
        residuals, trajectories, predictions, inputs and states, as far as the run has them.
    experiment
        The only experiment to read; all if None.
    """

    def parts(name: str, of: str = "output") -> dict[Key, pa.Table]:
        table = tables.get(name)
        if table is not None and experiment is not None and "experiment" in table.column_names:
            table = table.filter(pc.equal(table["experiment"], experiment))
        return _parts(table, of)

    simulated, predicted = parts("trajectories"), parts("predictions")
    inputs = _signals(parts("inputs", "input"), kept=lambda value: bool(np.ptp(value) > 0.0))
    states = _signals(parts("states", "state"))
    return {
        key: _curves(
            part,
            simulated.get(key),
            predicted.get(key),
            tuple(inputs.get(key[0], ())),
            tuple(states.get(key[0], ())),
        )
        for key, part in parts("residuals").items()
    }


def _signals(
    parts: Mapping[Key, pa.Table], kept: Callable[[FloatArray], bool] = lambda _: True
) -> dict[str, list[SignalCurve]]:
    """Return the stored inputs or states of each experiment."""
    found: dict[str, list[SignalCurve]] = {}
    for (experiment, name), part in parts.items():
        time, value = _column(part, "time"), _column(part, "value")
        if not kept(value):
            continue
        if "interpolation" in part.column_names and part["interpolation"][0].as_py() == "hold":
            time, value = np.repeat(time, 2)[1:], np.repeat(value, 2)[:-1]
        unit = part["unit"][0].as_py() or ""
        found.setdefault(experiment, []).append(SignalCurve(name, unit, time, value))
    return found


def _curves(
    table: pa.Table,
    finer: pa.Table | None,
    predicted: pa.Table | None,
    inputs: tuple[SignalCurve, ...],
    states: tuple[SignalCurve, ...],
) -> OutputCurves:
    """Return the rows of one output of one experiment as curves."""
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
    role = str(table["role"][0].as_py())
    return OutputCurves(role, time, measured, after, before, residual, fine, band, inputs, states)


def _parts(table: pa.Table | None, of: str = "output") -> dict[Key, pa.Table]:
    """Return the rows of each output of each experiment, which are consecutive in the table."""
    if table is None or not {"experiment", of} <= set(table.column_names) or not table.num_rows:
        return {}
    encoded = [table[name].combine_chunks().dictionary_encode() for name in ("experiment", of)]
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
    """Return a column with NaN for missing values."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), np.float64)
