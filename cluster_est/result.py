"""What a fit gives back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.methods.base import Solution
from cluster_est.problem import Problem
from cluster_est.uncertainty import BootstrapResult, ProfileResult, Uncertainty
from workers.messages import Experiment, FloatArray, Outcome, Output, Role


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
        "train", or "test" for a value that belongs to a test record alone; "known" if fixed,
        "derived" if it follows from others.
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
class ConstraintValue:
    """One constraint, a row of constraints.parquet.

    `before` and `after` are at the start and at the estimates, in units of the constraint's scale:
    at most 0 where `kind` is "<= 0", 0 where it is "= 0". NaN where a simulation failed.
    """

    constraint: str
    kind: str
    before: float
    after: float
    satisfied: bool


@dataclass(frozen=True)
class StartResult:
    """One start of several, a row of starts.parquet.

    Attributes
    ----------
    start
        Its number; 0 is the parameters' own.
    cost, ending, iterations
        Of its search.
    minimum
        Number of the minimum that it reached, 0 being the best; -1 if it reached none.
    """

    start: int
    cost: float
    ending: str
    iterations: int
    minimum: int


@dataclass(frozen=True)
class PointValue:
    """A value at one of several points worth keeping, a row of minima.parquet or front.parquet.

    `point` numbers them, the best first; `objectives` are costs kept apart.
    """

    point: int
    label: str
    value: float
    cost: float
    objectives: tuple[float, ...] = ()


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
    before
        Every experiment at the start values, without residuals; empty where all of them together
        would take too much memory.
    evaluations, simulated, failures, seconds
        What it took.
    search_seconds
        Of `seconds`, those since the workers stood ready.
    constraints
        On the training experiments; empty where there are none.
    starts, minima
        Of a multi-start: each start, and the values at each different minimum.
    front
        Of a method with several objectives: the points none of which is better in all.
    uncertainty
        Correlations and directions that the data do not determine, besides the intervals.
    profiles, bootstrap
        Intervals that took refits, where they were asked for.
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
    search_seconds: float = np.nan
    constraints: tuple[ConstraintValue, ...] = ()
    starts: tuple[StartResult, ...] = ()
    minima: tuple[PointValue, ...] = ()
    front: tuple[PointValue, ...] = ()
    uncertainty: Uncertainty | None = field(default=None, repr=False)
    profiles: tuple[ProfileResult, ...] = field(default=(), repr=False)
    bootstrap: BootstrapResult | None = field(default=None, repr=False)
    interrupted: bool = False
    before: tuple[Simulation, ...] = field(default=(), repr=False)

    @property
    def success(self) -> bool:
        """Whether the search reached a solution."""
        return self.solution.ending.success

    @property
    def x(self) -> dict[str, float]:
        """Estimated physical values by label."""
        searched = ("train", "test")
        return {e.label: e.value for e in self.estimates if e.estimated_on in searched}

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
        for output in experiment.outputs:
            spread = float(np.std(output.values)) or np.nan
            then = _rms(output_residuals(output, old.outcome))
            now = _rms(output_residuals(output, new.outcome))
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
        if experiment.curve is not None:
            rows.append(_curve_error(experiment, old.outcome, new.outcome))
    return tuple(rows)


def output_residuals(output: Output, outcome: Outcome) -> FloatArray | None:
    """(measured - simulated) / sigma of one output at its measured times; None if it failed.

    From the trajectory, whatever the cost makes of it.
    """
    trajectory = outcome.trajectory
    if trajectory is None:
        return None
    column = trajectory.variables.index(output.variable)
    rows = np.searchsorted(trajectory.times, output.times)
    simulated: FloatArray = trajectory.values[rows, column]
    return (output.values - simulated) / output.sigma


def curve_residuals(experiment: Experiment, outcome: Outcome) -> FloatArray | None:
    """Distances of a curve's segments, relative to its size; None if it failed, or has no curve."""
    if experiment.curve is None or outcome.trajectory is None:
        return None
    if experiment.cost_function is not None:
        return None
    count = len(experiment.curve.points) - 1
    return None if outcome.residuals is None else outcome.residuals[-count:]


def _curve_error(experiment: Experiment, old: Outcome, new: Outcome) -> OutputError:
    """Of a curve, whose distances are relative to its size already."""
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


def _rms(residuals: FloatArray | None) -> float:
    if residuals is None or not len(residuals):
        return np.nan
    return float(np.sqrt(np.mean(residuals**2)))
