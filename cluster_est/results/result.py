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
        What was asked.
    estimates
        Every number that was estimated or kept, shared ones first.
    solution
        Of the search on the training experiments.
    test_solution
        Of the search for values that belong to test records alone; None without such values.
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
        On the training experiments; empty without constraints.
    starts, minima
        Of a multi-start: each start, and the values at each different minimum.
    front
        Of a method with several objectives: the points none of which is better in all.
    uncertainty
        Correlations and directions that the data do not determine, besides the intervals.
    profiles, bootstrap, posterior
        Intervals that took refits or draws, where they were asked for.
    predictions
        Where the outputs lie by the posterior.
    diagnostics
        Whether the training residuals are white and as large as sigma says; None where that means
        nothing, see `diagnose_residuals`.
    solver_error
        What half the solver's step changes; None where no step decides, see `measure_solver_error`.
    interpolation
        An input that the measurements prefer to be interpolated otherwise; None where there is
        none, or nothing tells.
    record_faults
        What is wrong with a record, where one change mends it; empty where nothing was found.
    shapes
        Of the effects that the problem declares.
    shooting
        What segments of the records led to; None where the search did not go through them.
    failed_steps
        Sentences on what was to follow the search and failed; the estimates do not depend on it.
    interrupted
        Whether the user or the budget ended it.
    seed
        Of the method.
    states
        Of the model at the estimates, for some training experiments; see `with_states`.
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
        """Estimated physical values by label."""
        searched = ("train", "test")
        return {e.label: e.value for e in self.estimates if e.estimated_on in searched}

    @property
    def fun(self) -> FloatArray | None:
        """Residuals of the training experiments at the estimates, one after the other, over sigma.

        Behind those of an experiment stand those of the priors that count with it.

        None where a simulation failed.
        """
        at = self.solution.at
        return at.residuals if at is not None and at.ok else None

    @property
    def jac(self) -> FloatArray | None:
        """(residuals, unknowns): d `fun` / d the solution's x.

        x is logarithmic where a parameter's scale is. None where the method has none, or it is too
        large for one array.
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
        """The word for how it ended, as in run.json."""
        if self.interrupted:
            return "interrupted"
        return "done" if self.success else "not converged"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on simulations, residuals, uncertainty and outputs that are not followed."""
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
                "table: must be one of the tables of this fit but is "
                f"{name!r}{nearest(name, self.tables)}"
            )
        found = [dataclasses.asdict(row) for row in rows[name]]
        return pa.Table.from_pylist(found) if found else pa.table({})

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
            "intervals": interval_rows(self.profiles, drawn, self.posterior),
            "scales": observed_scales(self.problem, self.simulations),
            "categories": observed_categories(self.problem, self.simulations),
            "segments": () if self.shooting is None else self.shooting.states,
        }

    def rmse(self, role: Role) -> float:
        """Root mean square error over all outputs of the experiments with this role, in sigmas."""
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
