"""Whether the measurements prefer an input to be held, or joined by straight lines.

A file has the samples of an input, and not what was between them. Where a fit stands, the outputs
tell: the experiments are simulated once more with the other interpolation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cluster_est.errors import ClusterEstError
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.tables.jumps import count_jumps, interpolated, jump_times
from cluster_est.results.output_errors import Simulation
from cluster_est.results.residual_diagnostics import free_jacobian, training_residuals
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner
from cluster_est.statistics.changed_simulation import ChangedSimulation, compare_simulations
from cluster_est.statistics.records import make_records
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Input, Interpolation, Outcome

MOST_SIMULATIONS = 8
"""Simulations with the other interpolation, of all inputs together."""
MOST_INPUTS = 4
"""Inputs that are looked at; of more, those that differ most between the two."""
MOST_ENTRIES = 20_000_000
"""Entries of a Jacobian that the change is compared with."""

Simulate = Callable[[tuple[Experiment, ...], list[int]], list[Outcome]]
"""Residuals of changed experiments, with the values of those at these positions."""


@dataclass(frozen=True)
class FittedExperiments:
    """Training experiments where a fit stands.

    Attributes
    ----------
    problem
        Of the fit.
    experiments
        Indices of the training experiments.
    residuals : (n,)
        Stacked.
    jacobian : (n, unknowns)
        Of them.
    """

    problem: Problem
    experiments: tuple[int, ...]
    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)


@dataclass(frozen=True)
class PreferredInterpolation:
    """An input, and the other interpolation that the measurements prefer.

    Attributes
    ----------
    variable, preferred
        The input, and how it should be interpolated.
    key
        Of a config, that says so.
    share, error, fall
        See `ChangedSimulation`.
    experiments
        How many were simulated again.
    experiment, time
        Where most of the gain is: after this jump; NaN for an input without jumps.
    """

    variable: str
    preferred: Interpolation
    key: str
    share: float
    error: float
    fall: float
    experiments: int
    experiment: str
    time: float

    @property
    def sentence(self) -> str:
        """What the measurements say, and what to set."""
        held = self.preferred == "hold"
        how = "held between its samples" if held else "interpolated linearly"
        after = "" if np.isnan(self.time) else f" after the jump at {self.time:.6g} s"
        return (
            f"the model fits better with input {self.variable} {how}: the sum of squares falls by "
            f"{100.0 * self.fall:.2g} %, most of it in experiment {self.experiment}{after} (the "
            f"best mixture has {self.share:.2f} +- {self.error:.2g}, where 0 is the interpolation "
            f"of this fit and 1 the other one); set {self.key} and fit again"
        )


def interpolation_facts(found: PreferredInterpolation | None) -> dict[str, Any] | None:
    """Return what run.json says of it; None where nothing was found."""
    return None if found is None else dataclasses.asdict(found)


def preferred_interpolation(
    space: SearchSpace,
    solution: Solution,
    simulations: Sequence[Simulation],
    resources: Resources,
    runner: Runner,
) -> PreferredInterpolation | None:
    """Find the input of a fit that the measurements prefer to be interpolated otherwise.

    Parameters
    ----------
    space, solution
        Of the training experiments, with a Jacobian.
    simulations
        Of every experiment of the problem at the estimates, with trajectories.
    resources, runner
        See `simulate_with_solver`.

    Returns
    -------
    PreferredInterpolation or None
        None where no input can be told, or the measurements prefer what was fitted.
    """
    problem = space.problem
    if noise_names(problem):  # a Kalman filter follows the data whatever is between the samples
        return None
    residuals = training_residuals(space, simulations)
    if residuals is None:
        return None
    jacobian = free_jacobian(space, solution, len(residuals), MOST_ENTRIES)
    if jacobian is None:
        return None
    fitted = FittedExperiments(problem, space.experiments, residuals, jacobian)
    values = space.physical(solution.x)
    return compare_interpolations(fitted, at_fit(problem, values, resources, runner))


def at_fit(problem: Problem, values: FloatArray, resources: Resources, runner: Runner) -> Simulate:
    """Return what simulates changed experiments at the values of each, (experiments, names)."""

    def simulate(runs: tuple[Experiment, ...], positions: list[int]) -> list[Outcome]:
        return simulate_with_solver(
            problem, runs, values[positions], problem.model.solver, "residuals", resources,
            beside=runner,
        )  # fmt: skip

    return simulate


def compare_interpolations(
    fitted: FittedExperiments, simulate: Simulate
) -> PreferredInterpolation | None:
    """Simulate experiments with the other interpolation of each input that jumps or is held.

    Of each input the records are simulated in which the two differ most; few, as all inputs share
    `MOST_SIMULATIONS`. What the measurements say is decided by `compare_simulations`; of several
    inputs the one that they say most of is returned, as the others may only resemble it.

    Parameters
    ----------
    fitted
        Where a fit stands.
    simulate
        Simulates changed experiments.
    """
    problem = fitted.problem
    changes = _changes(problem, problem.describe(), fitted.experiments)
    if not changes:
        return None
    runs = tuple(
        _changed(problem.experiments[fitted.experiments[position]], change.variable)
        for change in changes
        for position in change.positions
    )
    try:
        outcomes = iter(simulate(runs, [p for change in changes for p in change.positions]))
    except ClusterEstError:  # a hint is missing then, and nothing else
        return None
    found: list[tuple[float, PreferredInterpolation]] = []
    for change in changes:
        own = [next(outcomes) for _ in change.positions]
        compared = _compared(fitted, change, own)
        if compared is not None and compared.preferred:
            strength = compared.share / compared.error if compared.error else np.inf
            found.append((strength, _preferred(fitted, change, compared)))
    return max(found, key=lambda each: each[0])[1] if found else None


@dataclass(frozen=True)
class _Change:
    """An input whose interpolation is changed, at these positions of the training experiments."""

    variable: str
    now: Interpolation
    positions: tuple[int, ...]


def _changes(
    problem: Problem, description: ModelDescription, experiments: Sequence[int]
) -> list[_Change]:
    """Return the inputs that can be told, those first that the interpolations differ most in."""
    sizes: dict[tuple[str, Interpolation], list[tuple[float, int]]] = {}
    for position, e in enumerate(experiments):
        run = problem.experiments[e]
        for given in run.inputs:
            size = _difference(given, run)
            told = given.interpolation == "hold" or count_jumps(given.times, given.values)
            if size > 0.0 and told and not description.holds(given.variable):
                key = given.variable, given.interpolation
                sizes.setdefault(key, []).append((size, position))
    largest = sorted(sizes.items(), key=lambda item: -max(item[1])[0])[:MOST_INPUTS]
    each = MOST_SIMULATIONS // max(len(largest), 1)
    return [
        _Change(name, now, tuple(sorted(p for _, p in sorted(found, reverse=True)[:each])))
        for (name, now), found in largest
    ]


def _difference(given: Input, run: Experiment) -> float:
    """Return the mean square difference of both interpolations, over the range squared."""
    inside = (given.times >= run.start) & (given.times <= run.stop)
    times, values = given.times[inside], given.values[inside]
    span = float(np.ptp(given.values)) if len(values) > 1 else 0.0
    if not span or not run.stop > run.start:
        return 0.0
    square = np.add.reduce(np.diff(values / span) ** 2 * np.diff(times))
    return float(square) / 3.0 / (run.stop - run.start)


def _changed(run: Experiment, variable: str) -> Experiment:
    """Return an experiment with the other interpolation of an input."""
    other: dict[Interpolation, Interpolation] = {"linear": "hold", "hold": "linear"}
    inputs = tuple(
        replace(i, interpolation=other[i.interpolation]) if i.variable == variable else i
        for i in run.inputs
    )
    return replace(run, inputs=inputs)


def _compared(
    fitted: FittedExperiments, change: _Change, outcomes: Sequence[Outcome]
) -> ChangedSimulation | None:
    """Compare both in the experiments that were simulated; None if one failed."""
    known = [each.residuals for each in outcomes if each.ok and each.residuals is not None]
    if len(known) < len(outcomes):
        return None
    rows, runs = _rows(fitted, change)
    changed, records = np.concatenate(known), make_records(runs)
    if len(changed) != len(rows) or not np.isfinite(changed).all():
        return None
    jacobian = fitted.jacobian[rows]
    return compare_simulations(fitted.residuals[rows], changed, jacobian, records)


def _rows(fitted: FittedExperiments, change: _Change) -> tuple[FloatArray, list[Experiment]]:
    """Return the rows of the experiments of a change in the stacked residuals, and those."""
    runs = [fitted.problem.experiments[e] for e in fitted.experiments]
    ends = np.cumsum([0, *(sum(len(o.times) for o in run.outputs) for run in runs)])
    rows = [np.arange(ends[p], ends[p + 1]) for p in change.positions]
    return np.concatenate(rows), [runs[p] for p in change.positions]


def _preferred(
    fitted: FittedExperiments, change: _Change, compared: ChangedSimulation
) -> PreferredInterpolation:
    """Say it of an input, with where most of the gain is."""
    _, runs = _rows(fitted, change)
    best = -np.inf, runs[0].id, np.nan
    for item in make_records(runs).items:
        run = runs[item.experiment]
        given = next(each for each in run.inputs if each.variable == change.variable)
        jumps, gain = jump_times(given), compared.gain[item.rows]
        since = np.searchsorted(jumps, item.times, side="right")
        sums = np.bincount(since, gain, minlength=len(jumps) + 1)[1:]
        place = (float(np.max(sums)), float(jumps[np.argmax(sums)])) if len(jumps) else None
        place = place or (float(np.add.reduce(gain)), np.nan)
        best = max(best, (place[0], run.id, place[1]), key=lambda each: each[0])
    preferred: Interpolation = "linear" if change.now == "hold" else "hold"
    return PreferredInterpolation(
        variable=change.variable,
        preferred=preferred,
        key=interpolated(change.variable, fitted.problem.columns, preferred),
        share=compared.share,
        error=compared.error,
        fall=compared.fall,
        experiments=len(runs),
        experiment=best[1],
        time=best[2],
    )
