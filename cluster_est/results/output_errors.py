"""Errors of the outputs: residuals from trajectories, and the table of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from cluster_est.errors import ProblemError
from cluster_est.problem import display
from cluster_est.problem.problem import Problem
from workers.messages import Experiment, FloatArray, Outcome, Output, Role, Trajectory
from workers.messages.types import by_content
from workers.residuals.observed import (
    bounds_of_categories,
    learnt_from,
    observed_residuals,
    scale_and_offset,
)
from workers.residuals.ordinal import CategoryBounds, disparities

if TYPE_CHECKING:
    import pandas as pd


@by_content
@dataclass(frozen=True)
class Simulation:
    """The simulation of one experiment with given values: its outcome, with trajectory."""

    experiment: int
    outcome: Outcome = field(repr=False)

    def to_frame(self) -> pd.DataFrame:
        """Return time and outputs as a pandas DataFrame; pandas must be installed.

        Raises
        ------
        ProblemError
            If the simulation failed; the message gives the reason.
        """
        found = self.outcome.trajectory
        if found is None:
            raise ProblemError(f"simulation: {self.outcome.status}: {self.outcome.message}")
        columns = dict(zip(found.variables, found.values.T, strict=True))
        return display.as_frame(pa.table({"time": found.times} | columns))


@by_content
@dataclass(frozen=True)
class OutputError:
    """The error of one output of one experiment, a row of errors.parquet.

    `before` is at the start values, `after` at the estimates. `rmse` is in the output's unit,
    `relative` is over the standard deviation of the measured signal, `normalised` over sigma. All
    are NaN if the simulation failed. For an ordinal output, errors are distances to the bounds of
    categories over the standard deviation of the simulated signal, and `relative` does not exist.
    """

    experiment: str
    role: Role
    output: str
    unit: str
    samples: int
    rmse_before: float
    rmse_after: float
    relative_before: float
    relative_after: float
    normalised_before: float
    normalised_after: float


def output_errors(
    problem: Problem, before: list[Simulation], after: list[Simulation], units: dict[str, str]
) -> tuple[OutputError, ...]:
    """Return the table of errors, from simulations at the start values and at the estimates."""
    rows = []
    for old, new in zip(before, after, strict=True):
        experiment = problem.experiments[old.experiment]
        for output in experiment.outputs:
            seen = ~output.is_hidden
            whole = bool(seen.all())  # the spread of a part is not known
            spread = (float(np.std(output.values)) or np.nan) if whole else np.nan
            spread = np.nan if output.ordinal else spread
            then, now = (_seen_residuals(output, each.outcome) for each in (old, new))
            sigmas = output.sigmas[seen]
            rmse_before, rmse_after = (
                _rms(None if each is None else each * sigmas) for each in (then, now)
            )
            rows.append(
                OutputError(
                    experiment=experiment.id,
                    role=experiment.role,
                    output=output.variable,
                    unit="" if output.ordinal else units.get(output.variable, ""),
                    samples=int(seen.sum()),
                    rmse_before=rmse_before,
                    rmse_after=rmse_after,
                    relative_before=rmse_before / spread,
                    relative_after=rmse_after / spread,
                    normalised_before=_rms(then),
                    normalised_after=_rms(now),
                )
            )
        if experiment.curve is not None:
            rows.append(_curve_error(experiment, old.outcome, new.outcome))
    return tuple(rows)


def output_residuals(output: Output, outcome: Outcome) -> FloatArray | None:
    """Return (measured - simulated) / sigma of one output at its measured times.

    The values come from the trajectory, with any cost. Free scales and offsets have their best
    values, and a detection limit is respected. None if the simulation failed.
    """
    trajectory = outcome.trajectory
    if trajectory is None:
        return None
    return observed_residuals(output, *simulated_values(output, trajectory))


def simulated_values(output: Output, trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return the simulated values at an output's times, and at the times of its reference data."""
    times = output.times, learnt_from(output).times
    first, second = (np.ascontiguousarray(trajectory.at(output.variable, each)) for each in times)
    return first, second


def compared_values(output: Output, outcome: Outcome) -> FloatArray | None:
    """Return the simulated values that are compared with an output; None if the simulation failed.

    Free scales and offsets have their best values.
    """
    trajectory = outcome.trajectory
    if trajectory is None:
        return None
    simulated, training = simulated_values(output, trajectory)
    scale, offset = scale_and_offset(output, simulated, training)
    return scale * simulated + offset


def fitted_categories(output: Output, trajectory: Trajectory | None) -> CategoryBounds | None:
    """Return the bounds of an ordinal output's categories; None for other outputs."""
    if trajectory is None or not output.ordinal or not len(output.times):
        return None
    found = bounds_of_categories(output, *simulated_values(output, trajectory))
    return found if found.spread > 0.0 else None


def measured_values(output: Output, outcome: Outcome) -> FloatArray:
    """Return the measured values of an output for a plot with the simulated values.

    An ordinal output has no such values. Instead, the value in each measured category that is
    nearest to the simulated value is returned; NaN if there is none.
    """
    if not output.ordinal:
        return output.values
    bounds = fitted_categories(output, outcome.trajectory)
    if bounds is None or outcome.trajectory is None:
        return np.full(len(output.values), np.nan)
    return disparities(bounds, output.values, simulated_values(output, outcome.trajectory)[0])


def curve_residuals(experiment: Experiment, outcome: Outcome) -> FloatArray | None:
    """Return distances of a curve's segments over its size; None without a curve or simulation."""
    if experiment.curve is None or outcome.trajectory is None:
        return None
    if experiment.cost_function is not None:
        return None
    count = len(experiment.curve.points) - 1
    return None if outcome.residuals is None else outcome.residuals[-count:]


def _curve_error(experiment: Experiment, old: Outcome, new: Outcome) -> OutputError:
    """Return the error of a curve; its distances are already relative to its size."""
    curve = experiment.curve
    then, now = _rms(curve_residuals(experiment, old)), _rms(curve_residuals(experiment, new))
    return OutputError(
        experiment=experiment.id,
        role=experiment.role,
        output="curve of " + ", ".join(curve.variables if curve is not None else ()),
        unit="",
        samples=0 if curve is None else len(curve.points),
        rmse_before=then,
        rmse_after=now,
        relative_before=then,
        relative_after=now,
        normalised_before=then,
        normalised_after=now,
    )


def _seen_residuals(output: Output, outcome: Outcome) -> FloatArray | None:
    """Return the residuals of values above a detection limit; None if the simulation failed."""
    residuals = output_residuals(output, outcome)
    return None if residuals is None else residuals[~output.is_hidden]


def _rms(residuals: FloatArray | None) -> float:
    if residuals is None or not len(residuals):
        return np.nan
    return float(np.sqrt(np.mean(residuals**2)))


def worse_than_constants(errors: Sequence[OutputError]) -> list[str]:
    """Return a sentence for each fitted output that a constant would fit better.

    The reason is often a wrong unit.
    """
    worst: dict[str, OutputError] = {}
    for each in errors:
        if each.role == "train" and 1.0 < each.relative_after < np.inf:
            known = worst.setdefault(each.output, each)
            worst[each.output] = max(known, each, key=lambda e: e.relative_after)
    return [
        f"a constant would fit {name} better than the fitted model: the error in {each.experiment} "
        f"is {each.relative_after:.3g} times the standard deviation of the measured signal; check "
        "columns and units"
        for name, each in worst.items()
    ]
