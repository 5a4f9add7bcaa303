"""What was measured, simulated and fed in, of each output of each experiment of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from workers.messages import FloatArray

Key = tuple[str, str]
"""An experiment and one of its outputs."""


@dataclass(frozen=True)
class InputCurve:
    """An input of an experiment: straight lines between its samples, or steps drawn as such."""

    name: str
    unit: str
    time: FloatArray = field(repr=False)
    value: FloatArray = field(repr=False)


@dataclass(frozen=True)
class OutputCurves:
    """One output of one experiment: what was measured and simulated, at the measured times.

    `before` is NaN where it is not known; `fine` are the simulated curves with a time of their own,
    as time, after and before; `band` is where the output lies by the posterior; `inputs` are those
    of the experiment that do not stay the same.
    """

    role: str
    time: FloatArray = field(repr=False)
    measured: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)
    fine: tuple[FloatArray, FloatArray, FloatArray] | None = field(default=None, repr=False)
    band: tuple[FloatArray, FloatArray] | None = field(default=None, repr=False)
    inputs: tuple[InputCurve, ...] = field(default=(), repr=False)

    @property
    def span(self) -> float:
        """Seconds from the first to the last measured time."""
        known = self.time[np.isfinite(self.time)]
        return float(np.ptp(known)) if len(known) else 0.0

    @property
    def has_times(self) -> bool:
        """False of the points of a curve, which belong to none."""
        return bool(np.isfinite(self.time).any())


def recorded_curves(tables: Mapping[str, pa.Table | None]) -> dict[Key, OutputCurves]:
    """Read the curves of a run.

    Parameters
    ----------
    tables
        residuals, trajectories, predictions and inputs, None where the run has none.
    """
    simulated, predicted = _parts(tables["trajectories"]), _parts(tables["predictions"])
    inputs: dict[str, list[InputCurve]] = {}
    for (experiment, name), part in _parts(tables["inputs"], "input").items():
        time, value = _column(part, "time"), _column(part, "value")
        if np.ptp(value) > 0.0:
            if part["interpolation"][0].as_py() == "hold":
                time, value = np.repeat(time, 2)[1:], np.repeat(value, 2)[:-1]
            unit = part["unit"][0].as_py() or ""
            inputs.setdefault(experiment, []).append(InputCurve(name, unit, time, value))
    return {
        key: _curves(part, simulated.get(key), predicted.get(key), tuple(inputs.get(key[0], ())))
        for key, part in _parts(tables["residuals"]).items()
    }


def _curves(
    table: pa.Table,
    finer: pa.Table | None,
    predicted: pa.Table | None,
    inputs: tuple[InputCurve, ...],
) -> OutputCurves:
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
    role = str(table["role"][0].as_py())
    return OutputCurves(role, time, measured, after, before, residual, fine, band, inputs)


def _parts(table: pa.Table | None, of: str = "output") -> dict[Key, pa.Table]:
    """The rows of each output of each experiment, which stand behind each other in the table."""
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
    """A column with NaN for what is not there."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), np.float64)
