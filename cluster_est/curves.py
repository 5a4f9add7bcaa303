"""What was measured and what was simulated, as tables."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.problem import Problem
from cluster_est.result import Simulation


def residual_table(problem: Problem, simulations: tuple[Simulation, ...]) -> pa.Table:
    """Measured, simulated and residual at each measured time."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for simulation in simulations:
        residuals = simulation.outcome.residuals
        experiment = problem.experiments[simulation.experiment]
        first = 0
        for output in experiment.outputs:
            count = len(output.times)
            part = np.full(count, np.nan) if residuals is None else residuals[first : first + count]
            first += count
            columns["experiment"].append(np.full(count, experiment.id))
            columns["role"].append(np.full(count, experiment.role))
            columns["output"].append(np.full(count, output.variable))
            columns["time"].append(output.times)
            columns["measured"].append(output.values)
            columns["simulated"].append(output.values - part * output.sigma)
            columns["residual"].append(part)
    return pa.table({name: np.concatenate(parts) for name, parts in columns.items()})


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
