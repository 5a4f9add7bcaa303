"""The error of a solver's step at the end of a fit: the same experiments, with half the step."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cluster_est.errors import ClusterEstError
from cluster_est.executors import executor_class
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.output_errors import Simulation, output_residuals
from cluster_est.results.solver_error.finer_solver import SolverScale, solver_scale
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner
from workers.messages import Experiment, FloatArray, Outcome, Output, ResetPolicy, Solver, Want

MOST_EXPERIMENTS = 8
"""Experiments that are simulated again; of more, every n-th."""
NOTICED = 0.1
"""Share of what is left, or of the sigma, above which an error of the solver is said."""
FAINT_SOLVER_ERROR = 1e-3
"""Share of a signal's spread below which nothing is said where no sigma is given."""


@dataclass(frozen=True)
class OutputSolverError:
    """The error that a solver makes in one output, over the experiments that were simulated again.

    Attributes
    ----------
    output
        Its name.
    over_residual, over_spread
        Root mean square of the error over that of the residual, and over the spread of what was
        measured.
    over_sigma
        Over the sigma; NaN where none is given.
    """

    output: str
    over_residual: float
    over_spread: float
    over_sigma: float

    @property
    def noticed(self) -> bool:
        """Whether it may have moved the estimates by more than noise does."""
        if np.isfinite(self.over_sigma):
            return self.over_sigma > NOTICED and self.over_residual > NOTICED
        return self.over_residual > NOTICED and self.over_spread > FAINT_SOLVER_ERROR


@dataclass(frozen=True)
class SolverError:
    """The error of a solver's step at the estimates, taken as first order: twice what half does.

    Attributes
    ----------
    scale
        The step.
    experiments
        How many were simulated again.
    outputs
        The error of each.
    """

    scale: SolverScale
    experiments: int
    outputs: tuple[OutputSolverError, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence where the error is not small beside what the fit has left."""
        noticed = [output for output in self.outputs if output.noticed]
        if not noticed:
            return ()
        worst = max(noticed, key=lambda output: output.over_residual)
        advice = self.scale.advice(worst.over_residual / NOTICED, 1.0)
        return (
            f"{self.scale.name} is too long: it causes an error in {worst.output} that is "
            f"{worst.over_residual:.2g} times the remaining residual of this output, and "
            f"{worst.over_spread:.1%} of the signal; this error may have biased the parameters; "
            f"set {advice} and fit again",
        )


def solver_facts(error: SolverError | None) -> dict[str, Any] | None:
    """Return what run.json says of it; None where it was not measured."""
    if error is None:
        return None
    return {
        "step": error.scale.step,
        "experiments": error.experiments,
        "outputs": [dataclasses.asdict(output) for output in error.outputs],
    }


def measure_solver_error(
    space: SearchSpace,
    solution: Solution,
    simulations: Sequence[Simulation],
    resources: Resources,
    runner: Runner,
) -> SolverError | None:
    """Simulate training experiments again with half the step, where a fit stands.

    Only where a step decides how exact a simulation is: communication steps of an FMU, which may
    integrate with steps as long as those, and "rk4". Solvers with a tolerance keep it themselves.
    The simulations run one after the other in a process of their own, and are not logged: a log is
    of one solver. By L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357,
    doi:10.1098/rsta.1911.0009, an error of first order is twice what half a step changes.

    Parameters
    ----------
    space, solution
        Of the training experiments.
    simulations
        Of every experiment of the problem at the estimates, with trajectories.
    resources
        For the limits of a simulation, and of instances.
    runner
        Of the fit, whose workers may still be there.

    Returns
    -------
    SolverError or None
        None where no step decides, or where the finer one fails.
    """
    problem = space.problem
    if problem.model.solver.name not in ("fmu", "rk4"):
        return None
    positions = positions_of_few(len(space.experiments))
    runs = tuple(problem.experiments[space.experiments[p]] for p in positions)
    scale = solver_scale(problem.model, problem.describe(), runs)
    if scale.why_not or scale.fixed or not scale.step:
        return None
    outcomes = {s.experiment: s.outcome for s in simulations}
    usual = [outcomes[space.experiments[p]] for p in positions]
    try:
        values = space.physical(solution.x)[positions]
        finer = simulate_with_solver(
            problem, runs, values, scale.finer(), "trajectory", resources, beside=runner
        )
    except ClusterEstError:
        return None
    found = [
        _of_output(name, runs, usual, finer)
        for name in dict.fromkeys(output.variable for run in runs for output in run.outputs)
    ]
    return SolverError(scale, len(runs), tuple(each for each in found if each is not None))


def positions_of_few(experiments: int) -> list[int]:
    """Return which of some experiments are simulated once more: all, or every n-th."""
    return list(range(0, experiments, max(1, -(-experiments // MOST_EXPERIMENTS))))


def simulate_with_solver(
    problem: Problem,
    runs: tuple[Experiment, ...],
    values: FloatArray,
    solver: Solver,
    want: Want,
    resources: Resources,
    *,
    beside: Runner | None,
) -> list[Outcome]:
    """Simulate experiments with another solver, in a process of their own where there are such.

    They are not logged.

    Parameters
    ----------
    problem
        Its model and effects are simulated.
    runs
        Of its experiments.
    values : (runs, parameters)
        Physical values of the model's parameters.
    solver, want
        How, and what for.
    resources
        For the limits of a simulation, and of instances.
    beside
        Whose first worker lets its instance go before, where their number is limited; None where
        no workers are there yet.

    Raises
    ------
    ClusterEstError
        If no process can be started, or the FMU cannot be loaded.
    """
    # what a simulation leaves behind must not look like an error of the solver
    reset: ResetPolicy = "instance" if problem.model.reset == "auto" else problem.model.reset
    if resources.instances is not None and beside is not None:  # and instances are expensive
        reset = beside.free_instances(1)
    model = replace(problem.model, solver=solver, reset=reset, seats=resources.seats)
    kind = executor_class("processes" if hasattr(os, "fork") else "local")
    with kind.open(model, runs, 1, None, resources.limits) as pool:
        return Runner(pool).simulate(
            values, tuple(range(len(runs))), want, "numerical error", problem.effects
        )


def _of_output(
    name: str, runs: Sequence[Experiment], usual: Sequence[Outcome], finer: Sequence[Outcome]
) -> OutputSolverError | None:
    """The error of one output; None where it could not be simulated."""
    errors, residuals, values, given = [], [], [], []
    for run, before, after in zip(runs, usual, finer, strict=True):
        for output in run.outputs:
            if output.variable == name:
                coarse, fine = (output_residuals(output, each) for each in (before, after))
                if coarse is None or fine is None or not len(coarse):
                    continue
                errors.append(2.0 * (coarse - fine))
                residuals.append(coarse)
                values.append(_centred(output))
                given.append(output.has_sigma and not output.ordinal)
    if not errors:
        return None
    error, residual, spread = (_rms(parts) for parts in (errors, residuals, values))
    return OutputSolverError(
        name,
        error / residual if residual > 0.0 else 0.0,
        error / spread if spread > 0.0 else 0.0,
        error if all(given) else np.nan,
    )


def _centred(output: Output) -> FloatArray:
    """The measured signal around its mean, over its sigma.

    Grades have no such size; what they are compared with is over its spread already.
    """
    if output.ordinal:
        return np.full(len(output.values), 1.0 / output.sigma)
    return (output.values - np.mean(output.values)) / output.sigmas


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
