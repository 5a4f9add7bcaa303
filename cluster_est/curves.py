"""What was measured and what was simulated, as tables."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.output_errors import Simulation, curve_residuals, output_residuals
from cluster_est.problem import Problem
from workers.messages import Experiment, FloatArray


def residual_table(problem: Problem, simulations: tuple[Simulation, ...]) -> pa.Table:
    """Measured, simulated and residual at each measured time."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        for output in experiment.outputs:
            found = output_residuals(output, simulation.outcome)
            part = np.full(len(output.times), np.nan) if found is None else found
            _add(columns, experiment, output.variable, part)
            columns["time"].append(output.times)
            columns["measured"].append(output.values)
            columns["simulated"].append(output.values - part * output.sigma)
        distances = curve_residuals(experiment, simulation.outcome)
        if experiment.curve is not None and distances is not None:
            _add(
                columns, experiment, "curve of " + ", ".join(experiment.curve.variables), distances
            )
            for name in ("time", "measured", "simulated"):  # a distance belongs to none of them
                columns[name].append(np.full(len(distances), np.nan))
    names = ["experiment", "role", "output", "time", "measured", "simulated", "residual"]
    return pa.table({name: _joined(columns[name]) for name in names})


def _add(
    columns: dict[str, list[Any]], experiment: Experiment, output: str, residuals: FloatArray
) -> None:
    columns["experiment"].append(np.full(len(residuals), experiment.id))
    columns["role"].append(np.full(len(residuals), experiment.role))
    columns["output"].append(np.full(len(residuals), output))
    columns["residual"].append(residuals)


def trajectory_table(problem: Problem, simulations: tuple[Simulation, ...]) -> pa.Table:
    """Simulated outputs at every time of each experiment's grid."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for simulation in simulations:
        trajectory = simulation.outcome.trajectory
        if trajectory is None:
            continue
        experiment = problem.experiments[simulation.experiment]
        for j, variable in enumerate(trajectory.variables):
            columns["experiment"].append(np.full(len(trajectory.times), experiment.id))
            columns["output"].append(np.full(len(trajectory.times), variable))
            columns["time"].append(trajectory.times)
            columns["simulated"].append(trajectory.values[:, j])
    return pa.table({name: np.concatenate(parts) for name, parts in columns.items()})


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0)
