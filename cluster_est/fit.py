"""The recipe of a fit."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Method
from cluster_est.problem.compatibility import check_observed_outputs, check_priors
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import check_process_noise
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.output_errors import Simulation
from cluster_est.results.residual_diagnostics import diagnose_residuals
from cluster_est.results.result import Result
from cluster_est.results.segments import ShootingSummary
from cluster_est.results.solver_error.measure import measure_solver_error
from cluster_est.results.tables import rows
from cluster_est.running.arguments import (
    check_problem,
    check_resources,
    check_values,
    method_of,
)
from cluster_est.running.environment import Monitor, RunEnvironment, open_executor
from cluster_est.running.multistart import (
    Multistart,
    MultistartResult,
    check_starts,
    search_from_starts,
)
from cluster_est.running.resources import Note, Record, Resources, Show, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.sizes import with_sizes
from cluster_est.shooting.record_segments import Shooting
from cluster_est.shooting.shoot import ShotFit, check_shooting, fit_whole_records, shoot
from cluster_est.uncertainty import (
    UncertaintySettings,
    bootstrap,
    check_bootstrap,
    check_posterior,
    check_profiles,
    examine,
    linearise,
    predicted_bands,
    profiles,
    sample_posterior,
)
from workers.messages.checks import check_kind, check_number

POSTERIOR = 3
"""Stream of the random generator of the posterior."""


@dataclass(frozen=True)
class FitPlan:
    """The method of a fit, with its starts, seed and intervals.

    Attributes
    ----------
    method
        Picks the points.
    seed
        Starts the method's random generator.
    multistart
        From how many starts.
    uncertainty
        Which intervals to compute by refits.
    shooting
        Whether the search goes through segments of the records first, and through which.
    """

    method: Method = field(default_factory=LeastSquares)
    seed: int = 0
    multistart: Multistart = field(default_factory=Multistart)
    uncertainty: UncertaintySettings = field(default_factory=UncertaintySettings)
    shooting: Shooting | None = None

    def check(self) -> None:
        """Refuse what no config would be allowed to ask for.

        Raises
        ------
        ProblemError
            If a value is of the wrong kind or out of its range.
        """
        given = self.multistart
        advice = f"; write Multistart({given!r})" if isinstance(given, int) else ""
        check_kind(given, Multistart, "multistart", ProblemError, advice)
        check_kind(self.uncertainty, UncertaintySettings, "uncertainty", ProblemError)
        check_number(self.seed, "method.seed", ProblemError, least=0, whole=True)
        if self.shooting is not None:
            check_kind(self.shooting, Shooting, "method.shooting", ProblemError)
            if self.multistart.searches > 1:
                raise ProblemError(
                    "method.shooting: begins once, at the parameters' starts, but multistart asks "
                    f"for {self.multistart.searches} starts; leave one of the two out"
                )


def fit(
    problem: Problem,
    method: Method | str | None = None,
    resources: Resources | None = None,
    seed: int = 0,
    *,
    record: Record | None = None,
    show: Show | None = None,
    note: Note | None = None,
    multistart: Multistart | None = None,
    uncertainty: UncertaintySettings | None = None,
    shooting: Shooting | Mapping[str, Any] | None = None,
) -> Result:
    """Estimate all parameters of a problem from its training experiments, together.

    Values that belong to test records alone are then estimated on those; everything shared stays
    as the training experiments gave it.

    Parameters
    ----------
    problem
        Model, parameters and experiments.
    method
        What picks the points, or its name as in a config ("sqp"); least squares if None.
    resources
        Where simulations run, and the budget.
    seed
        Starts the method's random generator.
    record, show, note
        Called for each simulation, whenever something came back, and for each iteration; see
        `Runner`.
    multistart
        From how many starts; from the parameters' own if None.
    uncertainty
        Which intervals to compute by refits; none if None.
    shooting
        Segments of the records that the search goes through first, for models that are chaotic,
        unstable or drift, as {"segments": 20} or {"length": 0.5}; whole records alone if None.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If model, experiments, method and machine do not fit together.
    """
    plan = FitPlan(
        LeastSquares() if method is None else method_of(method),
        seed,
        Multistart() if multistart is None else multistart,
        UncertaintySettings() if uncertainty is None else uncertainty,
        Shooting.of(shooting),
    )
    resources = Resources() if resources is None else resources
    check_problem(problem)
    check_resources(resources)
    plan.check()
    return fit_in(RunEnvironment(resources, Monitor(record, show, note)), problem, plan)


def fit_in(environment: RunEnvironment, problem: Problem, plan: FitPlan) -> Result:
    """Fit with workers, listeners and a budget that somebody else has chosen.

    Parameters
    ----------
    environment
        All that surrounds the fit.
    problem, plan
        What is fitted, and how.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If model, experiments, method and machine do not fit together.
    """
    begin = time.monotonic()
    problem.describe()
    train = check_search(problem, plan)
    with one_blas_thread():
        shot = _shoot(environment, train, plan)
        if shot is not None:
            environment = environment.left(shot.evaluations, time.monotonic() - begin)
        with environment.executor(problem) as executor:
            runner = environment.runner(executor)
            result = fit_on(runner, train, plan, shot)
    in_one_piece = result.shooting is None or result.shooting.joined
    if not result.interrupted and in_one_piece:
        steps, solution, after = GuardedSteps(), result.solution, result.simulations
        error = steps.do(
            "the error of the solver",
            lambda: measure_solver_error(train, solution, after, environment.resources, runner),
            None,
        )
        failed = (*result.failed_steps, *steps.failed)
        result = replace(result, solver_error=error, failed_steps=failed)
    return replace(result, seconds=time.monotonic() - begin)


def _shoot(environment: RunEnvironment, train: SearchSpace, plan: FitPlan) -> ShotFit | None:
    """Fit in segments, if that is asked for."""
    if plan.shooting is None:
        return None
    assert isinstance(plan.method, LeastSquares)
    return shoot(environment, train, plan.method, plan.shooting, plan.seed)


def fit_on(
    runner: Runner, train: SearchSpace, plan: FitPlan, shot: ShotFit | None = None
) -> Result:
    """Fit on workers that are there already; linear algebra must be in one thread.

    Parameters
    ----------
    runner
        Its executor has the experiments of the space's problem.
    train
        As `check_search` gave it.
    plan
        How to fit.
    shot
        What segments have found, if the search goes through them.
    """
    begin = time.monotonic()
    problem, method, seed = train.problem, plan.method, plan.seed
    units = {name: each.unit for name, each in problem.describe().variables.items()}
    runner.interrupted = shot is not None and shot.interrupted
    before = simulate_all(runner, problem, {})
    train = with_sizes(runner, train)
    found, summary = _search(runner, train, plan, shot)
    in_segments = shot is not None and summary is not None and not summary.joined
    segmented = shot.simulations if shot is not None and in_segments else ()
    solution, known, steps = found.best, None, GuardedSteps()
    linear = solution
    if not segmented and not runner.interrupted:
        linear = steps.do(
            "the derivatives at the solution",
            lambda: linearise(runner, train, solution),
            solution,
        )
        known = steps.assessed(train, linear, lambda: examine(runner, train, linear))
    result = complete(
        runner,
        train,
        solution,
        method,
        before,
        units=units,
        seed=seed,
        begin=begin,
        steps=steps,
        uncertainty=known,
        segmented=segmented,
    )
    starts, minima = rows.starts_and_minima(train, found)
    after = result.simulations
    left = steps.do(
        "what is left in the residuals", lambda: diagnose_residuals(train, linear, after), None
    )
    result = replace(result, starts=starts, minima=minima, diagnostics=left, shooting=summary)
    if segmented and summary is not None:
        asked = plan.uncertainty.asked
        result = replace(result, shooting=replace(summary, left_out=asked))
    if not segmented and not runner.interrupted:
        if problem.effects:
            result = with_shapes(runner, train, result, steps)
        if solution.ending.success:
            result = refine(runner, train, result, plan, steps)
    if shot is not None:
        result = replace(
            result,
            evaluations=result.evaluations + shot.evaluations,
            simulated=result.simulated + shot.simulated,
            failures=result.failures + shot.failures,
        )
    return replace(
        result,
        failed_steps=tuple(steps.failed),
        interrupted=runner.interrupted,
        search_seconds=time.monotonic() - begin,
    )


def _search(
    runner: Runner, train: SearchSpace, plan: FitPlan, shot: ShotFit | None
) -> tuple[MultistartResult, ShootingSummary | None]:
    if shot is None:
        return search_from_starts(runner, train, plan.method, plan.multistart, plan.seed), None
    whole = fit_whole_records(runner, train, plan.method, shot, plan.seed)
    return whole.found, whole.summary


def with_shapes(runner: Runner, train: SearchSpace, result: Result, steps: GuardedSteps) -> Result:
    """Add the shapes of the effects that the problem declares."""
    from cluster_est.results.shapes.visited_signals import (
        declared_shapes,  # SymPy is slow to import
    )

    shapes = steps.do(
        "the shapes of the effects", lambda: declared_shapes(runner, train, result), ()
    )
    simulated, failures = runner.simulations, runner.failures
    return replace(result, shapes=shapes, simulated=simulated, failures=failures)


def refine(
    runner: Runner, train: SearchSpace, result: Result, plan: FitPlan, steps: GuardedSteps
) -> Result:
    """Add the intervals that take more simulations: profiles, bootstrap and posterior."""
    solution, method, settings = result.solution, plan.method, plan.uncertainty
    local = method if method.needs_residuals else LeastSquares()
    if not _accepts(local, train):
        local = method
    profiled = steps.do("profiles", lambda: profiles(runner, train, solution, local, settings), ())
    drawn = None
    if settings.bootstrap:
        generator = np.random.default_rng(plan.seed)
        drawn = steps.do(
            "the bootstrap",
            lambda: bootstrap(runner, train, solution, local, settings, generator),
            None,
        )
    result = replace(result, profiles=profiled, bootstrap=drawn)
    if not settings.posterior or result.uncertainty is None:
        return result
    generator = np.random.default_rng((plan.seed, POSTERIOR))
    around = result.uncertainty.intervals
    posterior = steps.do(
        "the posterior",
        lambda: sample_posterior(runner, train, solution, around, settings, generator),
        None,
    )
    if posterior is None:
        return result
    own = {e.label: e.value for e in result.estimates if e.estimated_on == "test"}
    bands = steps.do(
        "predictions", lambda: predicted_bands(runner, train.problem, posterior, own), ()
    )
    return replace(result, posterior=posterior, predictions=bands)


def simulate(
    problem: Problem, resources: Resources | None = None, values: Mapping[str, float] | None = None
) -> list[Simulation]:
    """Simulate every experiment once, at the start values or at values given by label.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If the FMU cannot be run in this way, or a label is unknown.
    """
    check_problem(problem)
    resources = Resources() if resources is None else resources
    check_resources(resources)
    check_values(problem, values or {})
    problem.describe()
    with open_executor(problem, resources) as executor:
        return simulate_all(Runner(executor), problem, dict(values or {}))


def check_search(problem: Problem, plan: FitPlan) -> SearchSpace:
    """Return the space of the training experiments, if it can be searched as is asked.

    Raises
    ------
    ProblemError
        If the method, the starts or the intervals do not suit the problem.
    """
    check_priors(problem)
    check_observed_outputs(problem)
    check_process_noise(problem)
    train = make_space(problem, problem.indices("train"))
    check_method(plan.method, train)
    check_starts(train, plan.multistart)
    check_profiles(train, plan.uncertainty)
    if plan.uncertainty.bootstrap:
        check_bootstrap(train)
    if plan.uncertainty.posterior:
        check_posterior(train, plan.uncertainty.walkers)
    if plan.shooting is not None:
        check_shooting(train, plan.method, plan.shooting)
    return train


def _accepts(method: Method, space: SearchSpace) -> bool:
    try:
        check_method(method, space)
    except ProblemError:
        return False
    return True


def check_method(method: Method, space: SearchSpace) -> None:
    """Refuse a method that cannot solve this problem.

    Raises
    ------
    ProblemError
        If there is nothing to estimate, or the method needs another cost.
    """
    if space.size == 0:
        raise ProblemError(
            "parameters: at least one must be free to be estimated from the training experiments, "
            "but all are fixed or known; to simulate only, use: cluster-est simulate"
        )
    cost = space.problem.cost
    probe = np.ones(len(space.outputs))
    if method.needs_residuals and cost.weights(probe, space.outputs) is None:
        raise ProblemError(
            f"method.name: {method.name} needs residuals whose squares can be weighted, but "
            f"cost.name is {cost.name!r}; choose another of the two, such as the methods sqp or "
            "pattern_search"
        )
    if space.constraint_names and not method.keeps_constraints:
        raise ProblemError(
            f"method.name: {method.name} cannot satisfy constraints but there are some "
            f"({space.constraint_names[0]!r}); choose least_squares, sqp or pattern_search, or "
            "remove them"
        )
    method.check(space)
