"""The result of a fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from typing_extensions import override

from cluster_est.errors import RunFolderError
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.results.criteria import InformationCriteria, information_criteria
from cluster_est.results.curves import (
    StatePaths,
    input_table,
    posterior_table,
    prediction_table,
    residual_table,
    state_table,
    trajectory_table,
)
from cluster_est.results.facts import fit_facts, fit_notes
from cluster_est.results.fit_tables import (
    ConstraintValue,
    EffectCurve,
    Estimate,
    PointValue,
    StartResult,
)
from cluster_est.results.interpolation import PreferredInterpolation
from cluster_est.results.observation import observed_categories, observed_scales
from cluster_est.results.output_errors import OutputError, Simulation
from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.segments import ShootingSummary
from cluster_est.results.shapes.effect_table import curve_table
from cluster_est.results.solver_error.measure import SolverError
from cluster_est.results.view import ResultView, short_text
from cluster_est.statistics.residual_findings import ResidualDiagnostics
from cluster_est.uncertainty import (
    BootstrapResult,
    PosteriorResult,
    PredictedBand,
    ProfileResult,
    Uncertainty,
)
from cluster_est.uncertainty.uncertainty_rows import (
    bootstrap_rows,
    correlation_rows,
    direction_rows,
    interval_rows,
    profile_rows,
)
from workers.fmu.description import nearest
from workers.messages import FloatArray, Role
from workers.messages.checks import check_text
from workers.messages.types import by_content


@by_content
@dataclass(frozen=True, repr=False)
class Result(ResultView):
    """The result of a fit.

    Attributes
    ----------
    problem
        The fitted problem.
    estimates
        All values that were estimated or kept; shared values come first.
    solution
        Result of the search on the training experiments.
    test_solution
        Result of the search for values that belong only to test records; None without such values.
    cost_before, cost
        Cost of the training experiments, at the start values and at the estimates.
    errors
        Errors of each output of each experiment.
    simulations
        Simulations of all experiments at the estimates.
    before
        Simulations of all experiments at the start values, without residuals; empty if they would
        need too much memory.
    evaluations, simulated, failures, seconds
        Numbers of evaluated points, simulations and failed simulations, and the duration.
    search_seconds
        The part of `seconds` after the workers were ready.
    constraints
        Constraints on the training experiments; empty without constraints.
    starts, minima
        For a multi-start: each start, and the values at each different minimum.
    front
        For a method with several objectives: the Pareto front.
    uncertainty
        Intervals, correlations, and directions that the data do not determine.
    profiles, bootstrap, posterior
        Intervals from refits or draws, if they were requested.
    predictions
        Prediction intervals of the outputs from the posterior.
    diagnostics
        Whether the training residuals are white and agree with sigma; None if these tests do not
        apply, see `diagnose_residuals`.
    solver_error
        Error of the solver's step; None if no step size determines the accuracy, see
        `measure_solver_error`.
    interpolation
        An input for which the measurements prefer another interpolation; None if there is none, or
        if the data cannot show it.
    linear_inputs
        The inputs whose linear interpolation the measurements confirm.
    record_faults
        Faults of a record that one change corrects; empty if none was found.
    shapes
        Shapes of the effects that the problem declares.
    shooting
        Result of the search with segments (multiple shooting); None without segments.
    failed_steps
        Sentences on steps after the search that failed; the estimates do not depend on them.
    interrupted
        Whether the user or the budget ended the fit.
    seed
        Random seed of the method.
    states
        States of the model at the estimates, for some training experiments; see `with_states`.
    """

    problem: Problem
    estimates: tuple[Estimate, ...]
    solution: Solution
    test_solution: Solution | None
    cost_before: float
    cost: float
    errors: tuple[OutputError, ...]
    simulations: tuple[Simulation, ...]
    evaluations: int
    simulated: int
    failures: int
    seconds: float
    search_seconds: float = np.nan
    constraints: tuple[ConstraintValue, ...] = ()
    starts: tuple[StartResult, ...] = ()
    minima: tuple[PointValue, ...] = ()
    front: tuple[PointValue, ...] = ()
    uncertainty: Uncertainty | None = None
    profiles: tuple[ProfileResult, ...] = ()
    bootstrap: BootstrapResult | None = None
    posterior: PosteriorResult | None = None
    predictions: tuple[PredictedBand, ...] = ()
    diagnostics: ResidualDiagnostics | None = None
    solver_error: SolverError | None = None
    interpolation: PreferredInterpolation | None = None
    linear_inputs: tuple[str, ...] = ()
    record_faults: tuple[RecordFault, ...] = ()
    shapes: tuple[EffectCurve, ...] = ()
    shooting: ShootingSummary | None = None
    failed_steps: tuple[str, ...] = ()
    interrupted: bool = False
    seed: int = 0
    before: tuple[Simulation, ...] = ()
    states: tuple[StatePaths, ...] = ()

    @property
    def success(self) -> bool:
        """True if the search reached a solution."""
        return self.solution.ending.success

    @property
    def message(self) -> str:
        """The reason why the search ended."""
        return self.solution.message or str(self.solution.ending)

    @property
    def x(self) -> dict[str, float]:
        """The estimated physical values by label."""
        searched = ("train", "test")
        return {e.label: e.value for e in self.estimates if e.estimated_on in searched}

    @property
    def fun(self) -> FloatArray | None:
        """Residuals over sigma of all training experiments at the estimates.

        The residuals of an experiment are followed by those of the priors that belong to it. None
        if a simulation failed.
        """
        at = self.solution.at
        return at.residuals if at is not None and at.ok else None

    @property
    def jac(self) -> FloatArray | None:
        """Derivatives of `fun` with respect to the solution's x: (residuals, unknowns).

        x is a logarithm if a parameter's scale is logarithmic. None if the method computes no
        Jacobian, or if it is too large for one array.
        """
        return self.solution.jacobian

    @property
    def nfev(self) -> int:
        """Number of evaluated points, including those for finite differences."""
        return self.evaluations

    @property
    def nit(self) -> int:
        """Number of iterations of the search."""
        return self.solution.iterations

    @property
    @override
    def tables(self) -> tuple[str, ...]:
        optional = (name for name, rows in self.optional_rows().items() if rows)
        known = ("states", "shapes", "posterior", "predictions")
        wide = [name for name in known if getattr(self, name)]
        if any(experiment.inputs for experiment in self.problem.experiments):
            wide.insert(0, "inputs")
        return ("parameters", "errors", "residuals", "trajectories", *wide, *optional)

    @property
    def status(self) -> str:
        """The kind of ending, in the words of run.json."""
        if self.interrupted:
            return "interrupted"
        return "done" if self.success else "not converged"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on simulations, residuals, uncertainty and outputs with a poor fit."""
        return fit_notes(self)

    @override
    def facts(self) -> Mapping[str, Any]:
        return {"status": self.status} | fit_facts(self)

    @override
    def table(self, name: str) -> pa.Table:
        check_text(name, "table", RunFolderError)
        if name == "residuals":
            return residual_table(self.problem, self.simulations, self.before)
        if name == "trajectories":
            return trajectory_table(self.problem, self.simulations, self.before)
        if name == "inputs" and name in self.tables:
            return input_table(self.problem)
        if name == "states" and self.states:
            return state_table(self.states)
        if name == "shapes" and self.shapes:
            return curve_table(self.shapes)
        if name == "posterior" and self.posterior:
            return posterior_table(self.posterior)
        if name == "predictions" and self.predictions:
            return prediction_table(self.problem, self.predictions)
        rows: dict[str, Sequence[Any]] = {"parameters": self.estimates, "errors": self.errors}
        rows |= self.optional_rows()
        if not rows.get(name) and name not in self.tables:
            raise RunFolderError(
                "table: must be one of the tables of this fit, but is "
                f"{name!r}{nearest(name, self.tables)}"
            )
        found = [dataclasses.asdict(row) for row in rows[name]]
        return pa.Table.from_pylist(found) if found else pa.table({})

    def optional_rows(self) -> dict[str, Sequence[Any]]:
        """Return the rows of the optional tables by name; empty if the fit has no such table."""
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
            "intervals": interval_rows(self.profiles, drawn, self.posterior),
            "scales": observed_scales(self.problem, self.simulations),
            "categories": observed_categories(self.problem, self.simulations),
            "segments": () if self.shooting is None else self.shooting.states,
        }

    def rmse(self, role: Role) -> float:
        """Return the root mean square error over sigma for all experiments with a role."""
        rows = [e for e in self.errors if e.role == role]
        samples = np.array([e.samples for e in rows], np.float64)
        squares = samples * np.array([e.normalised_after for e in rows]) ** 2
        return float(np.sqrt(squares.sum() / samples.sum())) if rows else np.nan

    @cached_property
    @override
    def criteria(self) -> InformationCriteria:
        return information_criteria(self.problem, self.fun, len(self.solution.x))

    def __repr__(self) -> str:
        return short_text("Result", f"{self.message}, cost={self.cost:.6g}", self.x)
