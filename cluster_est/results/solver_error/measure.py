"""Measures the error of a solver's step after a fit, by simulations with half the step."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
from cluster_est.running.resources import Budget, Resources
from cluster_est.running.runner import Runner
from workers.messages import Experiment, FloatArray, Outcome, Output, ResetPolicy, Solver, Want

MOST_EXPERIMENTS = 8
"""Largest number of experiments that are simulated again; if there are more, every n-th is used."""
NOTICED = 0.1
"""Ratio of the solver error to the residual, and to sigma, above which the error is reported."""
FAINT_SOLVER_ERROR = 1e-3
"""Ratio of the solver error to a signal's standard deviation up to which the error is not reported
if no sigma is given."""


@dataclass(frozen=True)
class OutputSolverError:
    """The solver error in one output, over the experiments that were simulated again.

    Attributes
    ----------
    over_residual, over_spread
        Root mean square of the error, over that of the residual, and over the standard deviation of
        the measured signal.
    over_sigma
        Root mean square of the error over sigma; NaN if no sigma is given.
    """

    output: str
    over_residual: float
    over_spread: float
    over_sigma: float

    @property
    def noticed(self) -> bool:
        """Whether the error may have changed the estimates by more than noise does."""
        if np.isfinite(self.over_sigma):
            return self.over_sigma > NOTICED and self.over_residual > NOTICED
        return self.over_residual > NOTICED and self.over_spread > FAINT_SOLVER_ERROR


@dataclass(frozen=True)
class SolverError:
    """The error of a solver's step at the estimates, for a method of first order.

    It is twice the change that half the step causes.

    Attributes
    ----------
    scale
        The setting that determines the step.
    experiments
        Number of experiments that were simulated again.
    outputs
        The errors of the outputs.
    """

    scale: SolverScale
    experiments: int
    outputs: tuple[OutputSolverError, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence if the error is not small compared with the residual of the fit."""
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
    """Return the entry of run.json on the solver error; None if it was not measured."""
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
    """Simulate training experiments at the estimates again, with half the step.

    This is done only if a step size determines the accuracy: for "rk4", and for the communication
    step of an FMU, which may integrate with steps of the same length. Solvers with a tolerance
    control their error themselves. The simulations run one after the other in a separate process.
    They are not logged, because a log is for only one solver. An error of first order is twice the
    change that half the step causes (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357,
    doi:10.1098/rsta.1911.0009).

    Parameters
    ----------
    space, solution
        Search space of the training experiments, and the fit's solution.
    simulations
        Simulations of all experiments at the estimates, with trajectories.
    resources
        Limits of a simulation and of FMU instances.
    runner
        Runner of the fit, whose workers may still exist.

    Returns
    -------
    SolverError or None
        None if no step size determines the accuracy, or if the finer simulation fails.
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
    """Return the positions of the experiments that are simulated again: all, or every n-th."""
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
    """Simulate experiments with another solver, in a separate process if the system allows it.

    Parameters
    ----------
    problem, runs, solver, resources, beside
        See `runner_beside`.
    values : (runs, parameters)
        Physical values of the model's parameters.
    want
        The kind of result.

    Raises
    ------
    ClusterEstError
        If no process can be started, or the FMU cannot be loaded.
    """
    with runner_beside(problem, runs, solver, resources, beside) as runner:
        return runner.simulate(
            values, tuple(range(len(runs))), want, "numerical error", problem.effects
        )


@contextmanager
def runner_beside(
    problem: Problem,
    runs: tuple[Experiment, ...],
    solver: Solver,
    resources: Resources,
    beside: Runner | None,
    budget: Budget | None = None,
) -> Iterator[Runner]:
    """Start a separate process, if the system allows it, whose simulations are not logged.

    Parameters
    ----------
    problem
        Gives the model and the effects.
    runs
        Experiments of the problem; they may be changed.
    solver
        The solver.
    resources
        Limits of a simulation and of FMU instances.
    beside
        Runner whose first worker frees its instance first, if the number of instances is limited;
        None if there are no workers yet.
    budget
        Budget of the searches. If it is used up, or if the user interrupts the run, the searches
        end with an error, because their results so far mean nothing.

    Raises
    ------
    ClusterEstError
        If no process can be started, or the FMU cannot be loaded.
    """
    # an incomplete reset of the FMU must not look like an error of the solver
    reset: ResetPolicy = "instance" if problem.model.reset == "auto" else problem.model.reset
    if resources.instances is not None and beside is not None:  # instances are then expensive
        reset = beside.free_instances(1)
    model = replace(problem.model, solver=solver, reset=reset, seats=resources.seats)
    kind = executor_class("processes" if hasattr(os, "fork") else "local")
    with kind.open(model, runs, 1, None, resources.limits) as pool:
        yield Runner(pool, budget, whole=budget is not None)


def _of_output(
    name: str, runs: Sequence[Experiment], usual: Sequence[Outcome], finer: Sequence[Outcome]
) -> OutputSolverError | None:
    """Return the error of one output; None if it could not be simulated."""
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
    """Return the measured signal minus its mean, over its sigma.

    Ordinal grades have no such size; the signal that is compared with them is already scaled.
    """
    if output.ordinal:
        return np.full(len(output.values), 1.0 / output.sigma)
    return (output.values - np.mean(output.values)) / output.sigmas


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
