"""Simulations as rows of the evaluation log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from cluster_est.executors.simulation_key import simulation_key
from cluster_est.run_folder.log_format import SCHEMA, logged_cost, residuals_hash
from cluster_est.running.records import TaskOrigin
from workers.messages import FloatArray, Outcome, Trajectory


class LogRow(NamedTuple):
    """A simulation, and when its answer came, in seconds since 1970."""

    origin: TaskOrigin
    outcome: Outcome
    ended: float


def batch_of(
    rows: Sequence[LogRow],
    model_key: str,
    experiments: Sequence[tuple[str, str]],
    *,
    residuals: bool,
) -> pa.RecordBatch:
    """Make the columns of the log.

    Parameters
    ----------
    rows
        In the order in which they ended.
    model_key
        The first part of each row's key.
    experiments
        (id, key) of each experiment, by index.
    residuals
        Whether residuals and trajectories are among them.
    """
    origins, outcomes, ended = zip(*rows, strict=True)
    paths = [outcome.trajectory if residuals else None for outcome in outcomes]
    names = [origin.installed or experiments[origin.task.experiment] for origin in origins]
    keys = [
        simulation_key(model_key, key, origin.task.effects, origin.task.values, origin.task.bound)
        for origin, (_, key) in zip(origins, names, strict=True)
    ]
    columns = [
        pa.array(keys),
        pa.array([origin.task.want for origin in origins]),
        pa.array([origin.search for origin in origins]),
        pa.array([origin.evaluation for origin in origins], pa.int64()),
        pa.array([origin.purpose for origin in origins]),
        pa.array([name for name, _ in names]),
        _lists([origin.task.values for origin in origins]),
        pa.array([[effect.name for effect in origin.task.effects] for origin in origins]),
        pa.array([str(outcome.status) for outcome in outcomes]),
        pa.array([outcome.message for outcome in outcomes]),
        pa.array([logged_cost(row.outcome, row.origin.task.want) for row in rows], pa.float64()),
        _lists([outcome.residuals if residuals else None for outcome in outcomes]),
        pa.array([residuals_hash(outcome.residuals) for outcome in outcomes], pa.string()),
        _lists([outcome.constraints if outcome.ok else None for outcome in outcomes]),
        pa.array([outcome.seconds for outcome in outcomes], pa.float64()),
        pa.array([outcome.worker for outcome in outcomes]),
        pa.array([path and list(path.variables) for path in paths], pa.list_(pa.string())),
        _lists([path and path.times for path in paths]),
        _lists([path and path.values.ravel() for path in paths]),
        pa.array(ended, pa.float64()),
        pa.array([_finite(origin.task.bound) for origin in origins], pa.float64()),
        pa.array([outcome.steps for outcome in outcomes], pa.int64()),
    ]
    return pa.RecordBatch.from_arrays(columns, schema=SCHEMA)


def size_of(outcome: Outcome) -> int:
    """Bytes of what is large in an outcome."""
    size = 0 if outcome.residuals is None else outcome.residuals.nbytes
    path: Trajectory | None = outcome.trajectory
    return size + (0 if path is None else path.times.nbytes + path.values.nbytes)


def _finite(bound: float) -> float | None:
    return bound if np.isfinite(bound) else None


def _lists(rows: Sequence[FloatArray | None]) -> pa.Array:
    lengths = [0 if row is None else len(row) for row in rows]
    flat = [row for row in rows if row is not None]
    ends = np.cumsum([0, *lengths]).astype(np.int32)
    missing = pa.array([row is None for row in rows])
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(pa.array(ends), pa.array(values), mask=missing)
