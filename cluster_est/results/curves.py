"""Tables of measured and simulated values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import (
    Simulation,
    compared_values,
    curve_residuals,
    measured_values,
    output_residuals,
)
from cluster_est.uncertainty import PosteriorResult, PredictedBand
from workers.messages import Experiment, FloatArray, Outcome, Output, Trajectory
from workers.messages.types import by_content


@by_content
@dataclass(frozen=True)
class StatePaths:
    """The states of the model in one experiment, at measured times.

    Attributes
    ----------
    experiment
        Id of the experiment.
    states, units
        Name and unit of each state in the FMU; "" if it declares no unit.
    times : (n,)
    values : (n, states)
    """

    experiment: str
    states: tuple[str, ...]
    units: tuple[str, ...]
    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)


def residual_table(
    problem: Problem,
    simulations: tuple[Simulation, ...],
    before: tuple[Simulation, ...] | None = None,
) -> pa.Table:
    """Return measured values, simulated values and residuals at each measured time.

    With `before`, the column "simulated_before" has earlier simulated values; null if unknown.
    """
    columns: dict[str, list[Any]] = defaultdict(list)
    earlier = {s.experiment: s.outcome for s in before or ()}
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        for output in experiment.outputs:
            found = output_residuals(output, simulation.outcome)
            part = np.full(len(output.times), np.nan) if found is None else found
            _add(columns, experiment, output.variable, part)
            columns["time"].append(output.times)
            columns["measured"].append(measured_values(output, simulation.outcome))
            columns["simulated"].append(_compared(output, simulation.outcome))
            columns["simulated_before"].append(
                _compared(output, earlier.get(simulation.experiment))
            )
        distances = curve_residuals(experiment, simulation.outcome)
        if experiment.curve is not None and distances is not None:
            _add(
                columns, experiment, "curve of " + ", ".join(experiment.curve.variables), distances
            )
            for name in (
                "time",
                "measured",
                "simulated",
                "simulated_before",
            ):  # a distance has no time and no values
                columns[name].append(np.full(len(distances), np.nan))
    names = ["experiment", "role", "output", "time", "measured", "simulated", "residual"]
    table = pa.table({name: _joined(columns[name]) for name in names})
    return table if before is None else _with_before(table, columns)


def _compared(output: Output, outcome: Outcome | None) -> FloatArray:
    """Return the simulated values that are compared with an output; NaN after a failure."""
    found = None if outcome is None else compared_values(output, outcome)
    return np.full(len(output.times), np.nan) if found is None else found


def input_table(problem: Problem) -> pa.Table:
    """Return the given samples of each input in each experiment."""
    columns: dict[str, list[Any]] = defaultdict(list)
    variables = problem.describe().variables
    for experiment in problem.experiments:
        for given in experiment.inputs:
            count = len(given.times)
            for name, text in (
                ("experiment", experiment.id),
                ("input", given.variable),
                ("unit", variables[given.variable].unit),
                ("interpolation", given.interpolation),
            ):
                columns[name].append(np.full(count, text))
            columns["time"].append(given.times)
            columns["value"].append(given.values)
    names = ["experiment", "input", "unit", "interpolation", "time", "value"]
    return pa.table({name: _joined(columns[name]) for name in names})


def state_table(paths: Sequence[StatePaths]) -> pa.Table:
    """Return each state of each experiment over time, at the estimates."""
    parts = [(each, j) for each in paths for j in range(len(each.states))]
    lengths = [len(each.times) for each, _ in parts]
    return pa.table(
        {
            "experiment": np.repeat([each.experiment for each, _ in parts], lengths),
            "state": np.repeat([each.states[j] for each, j in parts], lengths),
            "unit": np.repeat([each.units[j] for each, j in parts], lengths),
            "time": _joined([each.times for each, _ in parts]),
            "value": _joined([each.values[:, j] for each, j in parts]),
        }
    )


def posterior_table(posterior: PosteriorResult) -> pa.Table:
    """Return each unknown in each draw; draws are nearly independent if the chains have mixed."""
    values, densities, _ = posterior.thinned
    draw, walker, unknown = np.indices(values.shape).reshape(3, -1)
    return pa.table(
        {
            "draw": draw,
            "walker": walker,
            "label": pa.array(np.array(posterior.labels)[unknown]),
            "value": values.ravel(),
            "log_density": np.repeat(densities.ravel(), len(posterior.labels)),
        }
    )


def prediction_table(problem: Problem, bands: Sequence[PredictedBand]) -> pa.Table:
    """Return the posterior band of each output at each measured time."""
    columns: dict[str, list[Any]] = defaultdict(list)
    for band in bands:
        experiment = problem.experiments[band.experiment]
        columns["experiment"].append(np.full(len(band.times), experiment.id))
        columns["role"].append(np.full(len(band.times), experiment.role))
        columns["output"].append(np.full(len(band.times), band.output))
        for name in ("lower", "median", "upper"):
            columns[name].append(getattr(band, name))
        columns["time"].append(band.times)
    names = ["experiment", "role", "output", "time", "lower", "median", "upper"]
    return pa.table({name: _joined(columns[name]) for name in names})


def _add(
    columns: dict[str, list[Any]], experiment: Experiment, output: str, residuals: FloatArray
) -> None:
    columns["experiment"].append(np.full(len(residuals), experiment.id))
    columns["role"].append(np.full(len(residuals), experiment.role))
    columns["output"].append(np.full(len(residuals), output))
    columns["residual"].append(residuals)


def trajectory_table(
    problem: Problem,
    simulations: tuple[Simulation, ...],
    before: tuple[Simulation, ...] | None = None,
) -> pa.Table:
    """Return the simulated outputs at every time of each experiment's grid.

    For `before`, see `residual_table`.
    """
    columns: dict[str, list[Any]] = defaultdict(list)
    earlier = {s.experiment: s.outcome.trajectory for s in before or ()}
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
            then = earlier.get(simulation.experiment)
            columns["simulated_before"].append(_at(then, variable, trajectory.times))
    names = [name for name in columns if name != "simulated_before"]
    table = pa.table({name: np.concatenate(columns[name]) for name in names})
    return table if before is None else _with_before(table, columns)


def _at(trajectory: Trajectory | None, variable: str, times: FloatArray) -> FloatArray:
    """Return an output at the times of another simulation; NaN if its times differ."""
    if trajectory is None or variable not in trajectory.variables:
        return np.full(len(times), np.nan)
    if not np.array_equal(trajectory.times, times):
        return np.full(len(times), np.nan)
    found: FloatArray = trajectory.values[:, trajectory.variables.index(variable)]
    return found


def _with_before(table: pa.Table, columns: dict[str, list[Any]]) -> pa.Table:
    found = pa.array(_joined(columns["simulated_before"]), pa.float64(), from_pandas=True)
    return table.append_column("simulated_before", found)


def _joined(parts: list[Any]) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0)
