"""The records of a fit, with functions that simulate and fit them again after changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.sigmas import declares_sigma
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.noise.estimate import estimate_noise
from cluster_est.statistics.records import StackedRecords, make_records
from workers.messages import Experiment, FloatArray, Solver

AT_NOISE = 1.3
"""Largest ratio of residual to noise with which the model fits a record."""
BY_CHANCE = 4.0
"""Number of standard errors of a short record's residual that count as chance."""
OFF = 2.0
"""Ratio of residual to noise above which the model does not fit a record."""
LEAST_STEPS, STEPS_OF_SAMPLE = 20_000, 100
"""Limits of the solver steps for a changed record, because a wrong change may make it stiff."""
REFIT = LeastSquares(trials=1, max_iterations=15, ftol=1e-4, xtol=1e-5, differences="forward")


@dataclass(frozen=True)
class FittedRecords:
    """Training experiments at the estimates of a fit.

    Attributes
    ----------
    problem
        The fitted problem.
    space
        Search space of all training experiments.
    x : (unknowns,)
        The estimates in search coordinates.
    residuals : (n,), jacobian : (n, unknowns)
        Residuals and derivatives of all training experiments; fixed unknowns have zero columns.
    runner, resources
        Runner of the fit, for unchanged records; resources, for changed records.
    count
        Receives the number of simulations of changed records.
    """

    problem: Problem
    space: SearchSpace
    x: FloatArray
    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    runner: Runner = field(repr=False)
    resources: Resources = field(repr=False)
    count: Callable[[int], None] = field(default=lambda _: None, repr=False)

    @property
    def train(self) -> tuple[int, ...]:
        """Indices of the training experiments."""
        return self.space.experiments

    @cached_property
    def runs(self) -> list[Experiment]:
        """The training experiments."""
        return [self.problem.experiments[e] for e in self.train]

    @cached_property
    def records(self) -> StackedRecords:
        """The rows of each output and experiment."""
        return make_records(self.runs)

    @cached_property
    def estimates(self) -> dict[str, float]:
        """Physical values by label."""
        return self.space.estimates(self.x)

    @cached_property
    def noise_here(self) -> FloatArray:
        """The noise of each output at the estimates; see `noise`."""
        return self.noise(self.residuals, self.runs)

    def noise(self, residuals: FloatArray, runs: Sequence[Experiment]) -> FloatArray:
        """Return the noise of each output in units of sigma; at least 1 if its sigma is known."""
        outputs = [output for run in runs for output in run.outputs]
        measured = np.concatenate([o.values / o.sigmas for o in outputs])
        records = make_records(runs)
        found = np.nan_to_num(estimate_noise(residuals, records, measured))
        own = ([o for o in outputs if o.variable == name] for name in records.outputs)
        least = [1.0 if declares_sigma(each) else 1e-300 for each in own]
        return np.maximum(found, least)

    def levels(
        self, residuals: FloatArray, runs: Sequence[Experiment], noise: FloatArray
    ) -> FloatArray:
        """Return the largest root mean square residual of each experiment's outputs, over noise.

        The ratio is reduced for a short record, whose noise may be larger by chance.
        """
        found = np.zeros(len(runs))
        for item in make_records(runs).items:
            if len(item.times):
                size = float(np.sqrt(np.mean(residuals[item.rows] ** 2))) / noise[item.output]
                chance = 1.0 + BY_CHANCE / np.sqrt(2.0 * len(item.times))
                size *= AT_NOISE / max(AT_NOISE, chance)
                found[item.experiment] = max(found[item.experiment], size)
        return found

    def refit(self, spaces: Sequence[SearchSpace]) -> list[Solution]:
        """Fit unchanged records in each of these search spaces, which may leave out records."""
        return self.runner.run([SearchRequest("records", REFIT, space) for space in spaces])

    def limited_solver(self, runs: Sequence[Experiment]) -> Solver:
        """Return the solver with a limit of its steps for changed records."""
        samples = max((len(o.times) for run in runs for o in run.outputs), default=0)
        solver = self.problem.model.solver
        most = min(solver.max_steps, max(LEAST_STEPS, STEPS_OF_SAMPLE * samples))
        return replace(solver, max_steps=most)

    def simulate(self, runs: Sequence[Experiment], values: FloatArray) -> list[FloatArray | None]:
        """Return the residuals of changed experiments; None for a failed simulation.

        Parameters
        ----------
        runs, values
            The experiments, and a row of physical values for each of them.

        Raises
        ------
        ClusterEstError
            If no process can be started.
        """
        self.count(len(runs))
        outcomes = simulate_with_solver(
            self.problem, tuple(runs), values, self.limited_solver(runs), "residuals",
            self.resources, beside=self.runner,
        )  # fmt: skip
        return [each.residuals if each.ok else None for each in outcomes]

    def sensitivities(
        self, position: int, space: SearchSpace, x: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the residuals of one record and their derivatives for all unknowns of a space.

        Parameters
        ----------
        position
            Index of the record among the training experiments.
        space, x
            Search space of all training experiments, and the point.
        """
        acting = space.acting[position]
        steps = 1e-3 * np.maximum(np.abs(x), space.typical)
        steps = np.where(space.logarithmic, 1e-3, steps)
        points = np.tile(x, (len(acting) + 1, 1))
        for row, unknown in enumerate(acting.tolist(), start=1):
            up = x[unknown] + steps[unknown] <= space.upper[unknown]
            points[row, unknown] += steps[unknown] if up else -steps[unknown]
        values = np.array([space.physical(point)[position] for point in points])
        outcomes = self.runner.simulate(
            values,
            [self.train[position]] * len(points),
            "residuals",
            "records",
            self.problem.effects,
        )
        if any(not each.ok or each.residuals is None for each in outcomes):
            return None
        residuals = [np.asarray(each.residuals) for each in outcomes]
        matrix = np.zeros((len(residuals[0]), space.size))
        for row, unknown in enumerate(acting.tolist(), start=1):
            matrix[:, unknown] = (residuals[row] - residuals[0]) / (
                points[row, unknown] - x[unknown]
            )
        return residuals[0], matrix


def noise_rows(runs: Sequence[Experiment], noise: FloatArray) -> FloatArray:
    """Return the noise of each residual, from the noise of each output."""
    names = list(dict.fromkeys(o.variable for each in runs for o in each.outputs))
    parts = [
        np.full(len(o.times), noise[names.index(o.variable)]) for run in runs for o in run.outputs
    ]
    return np.concatenate(parts)
