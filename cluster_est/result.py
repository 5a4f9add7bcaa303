"""What a fit gives back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.methods.base import Ending, Solution
from cluster_est.problem import Problem
from workers.messages import FloatArray, Outcome, Role


@dataclass(frozen=True)
class Estimate:
    """One estimated number, a row of parameters.parquet.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" where the parameter has a value of its own there.
    parameter, variable, unit
        The parameter that it belongs to, the FMU's name and unit for it.
    scope
        "shared", or the experiment or group that the value is for.
    value, start, lower, upper
        Physical values.
    std_error, lower95, upper95
        NaN where the data do not determine the value, or hold it at a bound.
    at_bound
        "lower", "upper" or "".
    difference_step
        Step of the last finite difference, in search coordinates; NaN if there was none.
    estimated_on
        "train", or "test" for a value that belongs to a test record alone; "known" if fixed.
    """

    label: str
    parameter: str
    variable: str
    unit: str
    scope: str
    value: float
    start: float
    lower: float
    upper: float
    scale: str
    at_bound: str
    std_error: float
    lower95: float
    upper95: float
    difference_step: float
    estimated_on: str


@dataclass(frozen=True)
class OutputError:
    """How well one output of one experiment is followed, a row of errors.parquet.

    `before` is at the start values, `after` at the estimates. `rmse` is in the output's unit,
    `relative` is over the standard deviation of the measured signal, `normalised` over sigma. NaN
    where the simulation failed.
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


@dataclass(frozen=True)
class Simulation:
    """One experiment simulated at given values: its outcome, with trajectory."""

    experiment: int
    outcome: Outcome = field(repr=False)


@dataclass(frozen=True)
class Result:
    """The result of a fit.

    Attributes
    ----------
    problem
        What was asked.
    estimates
        Every number that was estimated or kept, shared ones first.
    solution
        Of the search on the training experiments.
    test_solution
        Of the search for values that belong to test records alone; None if there are none.
    cost_before, cost
        Of the training experiments, at the start and at the estimates.
    errors
        For each output of each experiment.
    simulations
        Every experiment at the estimates.
    evaluations, simulated, failures, seconds
        What it took.
    """

    problem: Problem = field(repr=False)
    estimates: tuple[Estimate, ...]
    solution: Solution
    test_solution: Solution | None
    cost_before: float
    cost: float
    errors: tuple[OutputError, ...]
    simulations: tuple[Simulation, ...] = field(repr=False)
    evaluations: int
    simulated: int
    failures: int
    seconds: float

    @property
    def success(self) -> bool:
        """Whether the search reached a solution."""
        return self.solution.ending.success

    @property
    def interrupted(self) -> bool:
        return self.solution.ending is Ending.INTERRUPTED

    @property
    def x(self) -> dict[str, float]:
        """Estimated physical values by label."""
        return {e.label: e.value for e in self.estimates if e.estimated_on != "known"}

    def rmse(self, role: Role) -> float:
        """Root mean square error over all outputs of the experiments with this role, in sigmas."""
        rows = [e for e in self.errors if e.role == role]
        samples = np.array([e.samples for e in rows], np.float64)
        squares = samples * np.array([e.normalised_after for e in rows]) ** 2
        return float(np.sqrt(squares.sum() / samples.sum())) if rows else np.nan


def output_errors(
    problem: Problem, before: list[Simulation], after: list[Simulation], units: dict[str, str]
) -> tuple[OutputError, ...]:
    """The table of errors, from each experiment simulated at the start and at the estimates."""
    rows = []
    for old, new in zip(before, after, strict=True):
        experiment = problem.experiments[old.experiment]
        first = 0
        for output in experiment.outputs:
            part = slice(first, first + len(output.times))
            first = part.stop
            spread = float(np.std(output.values)) or np.nan
            then, now = _rms(old.outcome, part), _rms(new.outcome, part)
            rows.append(
                OutputError(
                    experiment=experiment.id,
                    role=experiment.role,
                    output=output.variable,
                    unit=units.get(output.variable, ""),
                    samples=len(output.times),
                    rmse_before=then * output.sigma,
                    rmse_after=now * output.sigma,
                    relative_before=then * output.sigma / spread,
                    relative_after=now * output.sigma / spread,
                    normalised_before=then,
                    normalised_after=now,
                )
            )
    return tuple(rows)


def _rms(outcome: Outcome, part: slice) -> float:
    if outcome.residuals is None or part.stop == part.start:
        return np.nan
    values: FloatArray = outcome.residuals[part]
    return float(np.sqrt(np.mean(values**2)))
