"""Tests whether the measurements prefer another interpolation of an input: hold or linear.

A file contains only the samples of an input, not the values between them. The outputs can show
these: at the estimates, the experiments are simulated again with the other interpolation. If both
differ much, the estimates of one do not suit the other; then the parameters are fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from cluster_est.errors import BudgetError, ClusterEstError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.problem.tables.jumps import count_jumps, interpolated, jump_times
from cluster_est.problem.tables.sparse_inputs import few_samples
from cluster_est.results.output_errors import Simulation
from cluster_est.results.residual_diagnostics import free_jacobian, training_residuals
from cluster_est.results.solver_error.measure import runner_beside, simulate_with_solver
from cluster_est.running.resources import Budget, Resources
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.changed_simulation import (
    ChangedSimulation,
    compare_simulations,
    fall_as_good,
)
from cluster_est.statistics.records import make_records
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Input, IntArray, Interpolation, Outcome

MOST_SIMULATIONS = 8
"""Largest number of simulations with the other interpolation, for all inputs together."""
MOST_INPUTS = 4
"""Largest number of tested inputs; those are chosen whose two interpolations differ most."""
MOST_ENTRIES = 20_000_000
"""Largest number of entries of a Jacobian for this test."""
REFIT = LeastSquares(trials=1, max_iterations=15, ftol=1e-4, xtol=1e-5, differences="forward")
MOST_EVALUATIONS = 1000
"""Largest number of evaluations of the fits with another interpolation of an input."""
LEAST_FALL_OF_REFIT = 0.5
"""Least relative decrease of the sum of squares by a refit; with other estimates, the other
interpolation may compensate a part of another error. After a smaller decrease without a refit, the
larger part of the error has another cause, and a preference may be a part of its effect."""
LEAST_FALL_OF_SLOW = 0.65
"""Least decrease for an input with few samples but without jumps. A missing delay of about one of
its sampling intervals looks like a hold, but leaves a larger error."""


@dataclass(frozen=True)
class AtFit:
    """The estimates of a fit, at which changed experiments are simulated.

    Attributes
    ----------
    problem
        The fitted problem.
    values : (experiments, names)
        Physical values of each training experiment.
    estimates
        Physical values by label.
    resources, runner
        See `simulate_with_solver`.
    count
        Receives the number of simulations.
    """

    problem: Problem
    values: FloatArray = field(repr=False)
    estimates: Mapping[str, float]
    resources: Resources
    runner: Runner = field(repr=False)
    count: Callable[[int], None] = field(default=lambda _: None, repr=False)

    @classmethod
    def of(
        cls,
        space: SearchSpace,
        x: FloatArray,
        resources: Resources,
        runner: Runner,
        count: Callable[[int], None] = lambda _: None,
    ) -> Self:
        """Return the estimates at a point of a search space of all training experiments."""
        return cls(
            space.problem, space.physical(x), space.estimates(x), resources, runner, count
        )  # fmt: skip

    def simulate(self, runs: tuple[Experiment, ...], positions: Sequence[int]) -> list[Outcome]:
        """Simulate changed experiments with the values of the experiments at these positions."""
        self.count(len(runs))
        return simulate_with_solver(
            self.problem, runs, self.values[list(positions)], self.problem.model.solver,
            "residuals", self.resources, beside=self.runner,
        )  # fmt: skip

    def refit(self, runs: tuple[Experiment, ...]) -> list[Outcome]:
        """Fit changed experiments, from the estimates and from the start values.

        Returns their outcomes at the best point; none if they cannot be fitted or simulated, or if
        this takes too many evaluations.
        """
        problem = replace(self.problem, experiments=runs)
        every = tuple(range(len(runs)))
        spaces = [make_space(problem, every, starts=known) for known in (self.estimates, {})]
        if not all(space.size for space in spaces) or spaces[0].constraint_names:
            return []
        solver, budget = problem.model.solver, Budget(evaluations=MOST_EVALUATIONS)
        with runner_beside(problem, runs, solver, self.resources, self.runner, budget) as runner:
            try:
                requests = [SearchRequest("interpolation", REFIT, space) for space in spaces]
                found = runner.run(requests)
            except BudgetError:
                return []
            fits = [
                (each.cost, space.physical(each.x))
                for each, space in zip(found, spaces, strict=True)
                if np.isfinite(each.cost)
            ]
            self.count(runner.simulations)
            if not fits:
                return []
            _, values = min(fits, key=lambda fit: fit[0])
            return runner.simulate(values, every, "residuals", "interpolation", problem.effects)


@dataclass(frozen=True)
class FittedExperiments:
    """Training experiments at the estimates of a fit.

    Attributes
    ----------
    problem
        The fitted problem.
    experiments
        Indices of the training experiments.
    residuals : (n,)
        Residuals of all training experiments.
    jacobian : (n, unknowns)
        Derivatives of the residuals.
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
        The input, and its preferred interpolation.
    key
        The key of a config that sets this interpolation.
    share, error, fall
        See `ChangedSimulation`.
    experiments
        Number of experiments that were simulated again.
    experiment, time
        The experiment, and the time of the jump, after which most of the improvement is; the time
        is NaN for an input without jumps.
    slow
        Whether the input has few samples, without jumps, as from a slow sensor.
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
    slow: bool = False

    @property
    def explains_most(self) -> bool:
        """Whether the other interpolation removes most of the error; see `LEAST_FALL_OF_REFIT`."""
        return self.fall >= LEAST_FALL_OF_REFIT

    @property
    def sentence(self) -> str:
        """The result of the test, and the key to set."""
        held = self.preferred == "hold"
        how = "held between its samples" if held else "interpolated linearly"
        after = "" if np.isnan(self.time) else f" after the jump at {self.time:.6g} s"
        doubt = (
            "; a missing delay of about one sampling interval of this input would look the same"
            if self.slow
            else ""
        )
        if not self.explains_most:
            doubt = "; an effect that the model lacks, such as a play or a delay, may look the same"
        fall = "more than 99" if self.fall > 0.99 else f"{100.0 * self.fall:.2g}"
        return (
            f"the model fits better with input {self.variable} {how}: the sum of squares falls by "
            f"{fall} %, most of it in experiment {self.experiment!r}{after}; the "
            f"best mixture of both interpolations is {self.share:.2f} +- {self.error:.2g}, where 0 "
            f"is that of this fit and 1 the other one; set {self.key} and fit again{doubt}"
        )


@dataclass(frozen=True)
class InterpolationTest:
    """The result of the test of all inputs.

    Attributes
    ----------
    preferred
        The input with the clearest preference for the other interpolation; None if there is none.
    linear
        The inputs whose linear interpolation the measurements confirm: they reject a hold.
    positions
        Positions of the training experiments that show the preference.
    """

    preferred: PreferredInterpolation | None = None
    linear: tuple[str, ...] = ()
    positions: tuple[int, ...] = ()

    def as_good_as(
        self, runs: Sequence[Experiment], before: FloatArray, after: FloatArray, unknowns: int
    ) -> float:
        """Return the fall with which the preferred interpolation is as good as a larger model.

        Both are compared in the experiments that show the preference. `runs` are all training
        experiments, with the residuals `before` and `after`; see `fall_as_good`.
        """
        if not self.positions:
            return 0.0
        rows, own = _rows_at(runs, self.positions)
        return fall_as_good(before[rows], after[rows], make_records(own), unknowns)


def interpolation_facts(found: PreferredInterpolation | None) -> dict[str, Any] | None:
    """Return the entry of run.json; None if nothing was found."""
    return None if found is None else dataclasses.asdict(found)


def examine_interpolations(
    space: SearchSpace,
    solution: Solution,
    simulations: Sequence[Simulation],
    resources: Resources,
    runner: Runner,
    *,
    refits: bool = True,
) -> InterpolationTest:
    """Find the interpolations that the measurements prefer, and those that they confirm.

    The result contains no input if none can be tested.

    Parameters
    ----------
    space, solution
        Search space and solution of the training experiments, with a Jacobian.
    simulations
        Simulations of all experiments at the estimates, with trajectories.
    resources, runner
        See `simulate_with_solver`.
    refits
        See `compare_interpolations`.
    """
    problem = space.problem
    if noise_names(problem):  # a Kalman filter follows the data with any interpolation
        return InterpolationTest()
    residuals = training_residuals(space, simulations)
    if residuals is None:
        return InterpolationTest()
    if (jacobian := free_jacobian(space, solution, len(residuals), MOST_ENTRIES)) is None:
        return InterpolationTest()
    fitted = FittedExperiments(problem, space.experiments, residuals, jacobian)
    at = AtFit.of(space, solution.x, resources, runner)
    return compare_interpolations(fitted, at, refits=refits)


def with_effects_added(
    declared: InterpolationTest,
    again: InterpolationTest,
    as_good: float,
    imitable: Collection[str] = (),
) -> InterpolationTest:
    """Return the test of a model to which effects were added.

    A preference of the declared model may be a part of what these effects explain, so the test at
    the model with the effects decides. But these effects may also imitate the other interpolation.
    It remains if it alone is as good as the effects are, because it is the simpler explanation. It
    also remains if an effect at the same input, such as a delay, makes both interpolations alike.

    Parameters
    ----------
    declared, again
        The tests at the declared model and at the model with the effects.
    as_good
        Relative decrease of the sum of squares that is as good as the effects; see `as_good_as`.
    imitable
        Inputs with an effect that can imitate another interpolation.
    """
    known = declared.preferred
    if again.preferred is not None or known is None:
        return again
    alike = known.variable in imitable and known.variable not in again.linear
    if known.fall < as_good and not alike:
        return again
    linear = tuple(n for n in again.linear if n != known.variable)
    return replace(declared, linear=linear)


def compare_interpolations(
    fitted: FittedExperiments, at: AtFit, *, refits: bool = True
) -> InterpolationTest:
    """Simulate experiments with the other interpolation of some inputs.

    These inputs have jumps, a hold, or much fewer samples than other signals. For each input, only
    the records are simulated in which the two interpolations differ most, and all inputs share
    `MOST_SIMULATIONS`. `compare_simulations` decides. If another interpolation is preferred for
    several inputs, only the one with the clearest result is returned, because the others may only
    resemble it. `refits` says whether the parameters may be fitted again.
    """
    problem = fitted.problem
    changes = _changes(problem, problem.describe(), fitted.experiments)
    if not changes:
        return InterpolationTest()
    runs = tuple(run for change in changes for run in _changed_runs(fitted, change))
    try:
        outcomes = iter(at.simulate(runs, [p for change in changes for p in change.positions]))
        found: list[tuple[float, _Change, PreferredInterpolation]] = []
        linear: list[str] = []
        for change in changes:
            own = [next(outcomes) for _ in change.positions]
            compared = _compared(fitted, change, own)
            if refits:
                compared = _refitted(fitted, change, compared, at)
            if compared is not None and change.shown(compared):
                strength = compared.share / compared.error if compared.error else np.inf
                found.append((strength, change, _preferred(fitted, change, compared)))
            elif compared is not None and compared.refuted and change.now == "linear":
                linear.append(change.variable)
    except ClusterEstError:  # then only this hint is missing
        return InterpolationTest()
    if not found:
        return InterpolationTest(linear=tuple(linear))
    _, change, best = max(found, key=lambda each: each[0])
    return InterpolationTest(best, tuple(linear), change.positions)


def _refitted(
    fitted: FittedExperiments, change: _Change, compared: ChangedSimulation | None, at: AtFit
) -> ChangedSimulation | None:
    """Compare with a refit if the fitted interpolation is rejected, but the other one not shown.

    The comparison accounts for small changes of the parameters only.
    """
    if compared is None or change.shown(compared) or not compared.rejected:
        return compared
    again = _compared(fitted, change, at.refit(_changed_runs(fitted, change)))
    return again if again is not None and again.fall > LEAST_FALL_OF_REFIT else compared


@dataclass(frozen=True)
class _Change:
    """An input to change, and the positions of the training experiments in which to change it.

    `slow` says that it has few samples, without jumps; it may come from a slow sensor.
    """

    variable: str
    now: Interpolation
    positions: tuple[int, ...]
    slow: bool = False

    def shown(self, compared: ChangedSimulation) -> bool:
        """Return whether the measurements show that the other interpolation is right."""
        return compared.preferred and not (self.slow and compared.fall < LEAST_FALL_OF_SLOW)


def _changes(
    problem: Problem, description: ModelDescription, experiments: Sequence[int]
) -> list[_Change]:
    """Return the inputs that can be tested, first those whose interpolations differ most."""
    sizes: dict[tuple[str, Interpolation], list[tuple[float, int]]] = {}
    shown: set[tuple[str, Interpolation]] = set()
    for position, e in enumerate(experiments):
        run = problem.experiments[e]
        for given in run.inputs:
            size, key = _difference(given, run), (given.variable, given.interpolation)
            few = few_samples(run, given)
            told = given.interpolation == "hold" or count_jumps(given.times, given.values) > 0
            told = told or (few is not None and few.at_changes)
            if size > 0.0 and (told or few) and not description.holds(given.variable):
                sizes.setdefault(key, []).append((size, position))
                shown |= {key} if told else set()
    largest = sorted(sizes.items(), key=lambda item: -max(item[1])[0])[:MOST_INPUTS]
    each = MOST_SIMULATIONS // max(len(largest), 1)
    return [
        _Change(
            *key,
            tuple(sorted(p for _, p in sorted(found, reverse=True)[:each])),
            slow=key not in shown,
        )
        for key, found in largest
    ]


def _difference(given: Input, run: Experiment) -> float:
    """Return the mean square difference of both interpolations over the squared range."""
    inside = (given.times >= run.start) & (given.times <= run.stop)
    times, values = given.times[inside], given.values[inside]
    span = float(np.ptp(given.values)) if len(values) > 1 else 0.0
    if not span or not run.stop > run.start:
        return 0.0
    square = np.add.reduce(np.diff(values / span) ** 2 * np.diff(times))
    return float(square) / 3.0 / (run.stop - run.start)


def _changed_runs(fitted: FittedExperiments, change: _Change) -> tuple[Experiment, ...]:
    """Return the experiments of a change with the other interpolation of its input."""
    _, runs = _rows(fitted, change)
    return tuple(_changed(run, change.variable) for run in runs)


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
    """Compare both interpolations in the simulated experiments; None if a simulation failed."""
    known = [each.residuals for each in outcomes if each.ok and each.residuals is not None]
    if len(known) < len(change.positions):
        return None
    rows, runs = _rows(fitted, change)
    changed, records = np.concatenate(known), make_records(runs)
    if len(changed) != len(rows) or not np.isfinite(changed).all():
        return None
    jacobian = fitted.jacobian[rows]
    return compare_simulations(fitted.residuals[rows], changed, jacobian, records)


def _rows(fitted: FittedExperiments, change: _Change) -> tuple[IntArray, list[Experiment]]:
    """Return the residual rows of the experiments of a change, and these experiments."""
    runs = [fitted.problem.experiments[e] for e in fitted.experiments]
    return _rows_at(runs, change.positions)


def _rows_at(
    runs: Sequence[Experiment], positions: Sequence[int]
) -> tuple[IntArray, list[Experiment]]:
    """Return the residual rows of the experiments at some positions, and these experiments."""
    ends = np.cumsum([0, *(sum(len(o.times) for o in run.outputs) for run in runs)])
    rows = [np.arange(ends[p], ends[p + 1]) for p in positions]
    return np.concatenate(rows), [runs[p] for p in positions]


def _preferred(
    fitted: FittedExperiments, change: _Change, compared: ChangedSimulation
) -> PreferredInterpolation:
    """Return the finding for an input, with the place of the largest improvement."""
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
        slow=change.slow,
    )
