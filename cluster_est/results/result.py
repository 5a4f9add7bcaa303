"""What a fit gives back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.methods.base import Solution
from cluster_est.problem import display
from cluster_est.problem.problem import Problem
from cluster_est.results.curves import residual_table, trajectory_table
from cluster_est.results.output_errors import OutputError, Simulation
from cluster_est.uncertainty import BootstrapResult, ProfileResult, Uncertainty
from cluster_est.uncertainty.rows import (
    bootstrap_rows,
    correlation_rows,
    direction_rows,
    interval_rows,
    profile_rows,
)
from workers.fmu.description import nearest
from workers.messages import FloatArray, Role


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
    def message(self) -> str:
        """Why the search ended."""
        return self.solution.message or str(self.solution.ending)

    @property
    def x(self) -> dict[str, float]:
        """Estimated physical values by label."""
        searched = ("train", "test")
        return {e.label: e.value for e in self.estimates if e.estimated_on in searched}

    @property
    def fun(self) -> FloatArray | None:
        """Residuals of the training experiments at the estimates, one after the other, over sigma.

        None where a simulation failed.
        """
        at = self.solution.at
        return at.residuals if at is not None and at.ok else None

    @property
    def jac(self) -> FloatArray | None:
        """(residuals, unknowns): d `fun` / d the solution's x, which is logarithmic where a
        parameter's scale is; None where the method has none, or it is too large for one array.
        """
        return self.solution.jacobian

    @property
    def nfev(self) -> int:
        """Points that were asked for, those of finite differences included."""
        return self.evaluations

    @property
    def nit(self) -> int:
        """Iterations of the search."""
        return self.solution.iterations

    @property
    def parameters(self) -> pa.Table:
        """The table of that name: estimates with intervals."""
        return self.table("parameters")

    @property
    def residuals(self) -> pa.Table:
        """The table of that name: measured, simulated and residual at each measured time."""
        return self.table("residuals")

    @property
    def trajectories(self) -> pa.Table:
        """The table of that name: every simulated value."""
        return self.table("trajectories")

    @property
    def tables(self) -> tuple[str, ...]:
        """What `table` can give: a run folder's files have the same names."""
        optional = (name for name, rows in self.optional_rows().items() if rows)
        return ("parameters", "errors", "residuals", "trajectories", *optional)

    def table(self, name: str) -> pa.Table:
        """One of `tables`, with the columns that it has in a run folder.

        Raises
        ------
        RunFolderError
            If this fit has no such table.
        """
        if name == "residuals":
            return residual_table(self.problem, self.simulations, self.before)
        if name == "trajectories":
            return trajectory_table(self.problem, self.simulations, self.before)
        rows: dict[str, Sequence[Any]] = {"parameters": self.estimates, "errors": self.errors}
        rows |= self.optional_rows()
        if not rows.get(name):
            raise RunFolderError(
                f"table: must be one of the tables that this fit has but is {name!r}"
                f"{nearest(name, self.tables)}"
            )
        return pa.Table.from_pylist([dataclasses.asdict(row) for row in rows[name]])

    def optional_rows(self) -> dict[str, Sequence[Any]]:
        """Rows of the tables that not every fit has, by name; empty where it has none."""
        uncertainty, drawn = self.uncertainty, self.bootstrap
        return {
            "constraints": self.constraints,
            "starts": self.starts,
            "minima": self.minima,
            "front": self.front,
            "correlations": [] if uncertainty is None else correlation_rows(uncertainty),
            "directions": [] if uncertainty is None else direction_rows(uncertainty),
            "profiles": profile_rows(self.profiles),
            "bootstrap": [] if drawn is None else bootstrap_rows(drawn),
            "intervals": interval_rows(self.profiles, drawn),
        }

    def rmse(self, role: Role) -> float:
        """Root mean square error over all outputs of the experiments with this role, in sigmas."""
        rows = [e for e in self.errors if e.role == role]
        samples = np.array([e.samples for e in rows], np.float64)
        squares = samples * np.array([e.normalised_after for e in rows]) ** 2
        return float(np.sqrt(squares.sum() / samples.sum())) if rows else np.nan

    def __str__(self) -> str:
        """What `print` shows."""
        return display.plain(self._title, *fit_tables(self.estimates, self.errors))

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return display.section(self._title, *fit_tables(self.estimates, self.errors))

    @property
    def _title(self) -> str:
        return f"Result: {self.message}; cost {self.cost_before:.6g} before, {self.cost:.6g} after"


def fit_tables(
    estimates: Sequence[Estimate], errors: Sequence[Any]
) -> tuple[display.DisplayTable, display.DisplayTable]:
    """Estimates and errors, of a fit or of a closed loop, as a notebook shows them."""
    values = [
        (e.label, e.value, e.unit, e.std_error, e.lower95, e.upper95, e.at_bound) for e in estimates
    ]
    fits = [(e.experiment, e.role, e.output, e.rmse_before, e.rmse_after, e.unit) for e in errors]
    return (
        display.DisplayTable(
            "Parameters",
            ("parameter", "value", "unit", "standard error", "95 % from", "to", "at bound"),
            values,
        ),
        display.DisplayTable(
            "Root mean square errors",
            ("experiment", "role", "output", "before", "after", "unit"),
            fits,
        ),
    )
