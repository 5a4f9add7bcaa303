"""The recipe of a fit."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Method, Solution
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import SearchSpace, make_space
from cluster_est.results import rows
from cluster_est.results.output_errors import Simulation, output_errors
from cluster_est.results.result import Result
from cluster_est.running.evaluation import judge
from cluster_est.running.multistart import Multistart, check_starts, search_from_starts
from cluster_est.running.resources import Resources, one_blas_thread, open_executor
from cluster_est.running.runner import Note, Record, Runner, SearchRequest, Show
from cluster_est.running.search_state import suited
from cluster_est.uncertainty import (
    Uncertainty,
    UncertaintySettings,
    assess,
    bootstrap,
    check_bootstrap,
    check_profiles,
    examine,
    intervals,
    profiles,
)

BEFORE_BYTES = 2**28
"""Of all trajectories at the start values together: more are not kept until the end of a fit."""


def fit(
    problem: Problem,
    method: Method | None = None,
    resources: Resources | None = None,
    seed: int = 0,
    record: Record | None = None,
    show: Show | None = None,
    note: Note | None = None,
    multistart: Multistart | None = None,
    uncertainty: UncertaintySettings | None = None,
) -> Result:
    """Estimate all parameters of a problem from its training experiments, together.

    Values that belong to test records alone are then estimated on those; everything shared stays
    as the training experiments gave it.

    Parameters
    ----------
    problem
        Model, parameters and experiments.
    method
        What picks the points; least squares if None.
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

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If model, experiments, method and machine do not fit together.
    """
    method = method or LeastSquares()
    resources = resources or Resources()
    begin = time.monotonic()
    problem.describe()
    settings = uncertainty or UncertaintySettings()
    multistart = multistart or Multistart()
    train = check_search(problem, method, settings, multistart)
    with one_blas_thread(), open_executor(problem, resources) as executor:
        runner = Runner(executor, resources.budget, record, show, note)
        result = fit_on(runner, train, method, seed, multistart, settings)
    return replace(result, seconds=time.monotonic() - begin)


def fit_on(
    runner: Runner,
    train: SearchSpace,
    method: Method,
    seed: int,
    multistart: Multistart,
    settings: UncertaintySettings,
) -> Result:
    """A fit on workers that are there already; linear algebra must be in one thread.

    Parameters
    ----------
    runner
        Its executor has the experiments of the space's problem.
    train
        As `check_search` gave it.
    method, seed, multistart, settings
        As of `fit`.
    """
    begin = time.monotonic()
    problem = train.problem
    units = {name: each.unit for name, each in problem.describe().variables.items()}
    before = simulate_all(runner, problem, {})
    found = search_from_starts(runner, train, method, multistart, seed)
    solution, known = found.best, None
    if not runner.interrupted:
        known = examine(runner, train, solution)
    result = complete(runner, train, solution, method, before, units, seed, begin, known)
    starts, minima = rows.starts_and_minima(train, found)
    result = replace(result, starts=starts, minima=minima)
    if solution.ending.success and not runner.interrupted:
        result = refine(runner, train, result, method, settings, seed)
    return replace(result, interrupted=runner.interrupted, search_seconds=time.monotonic() - begin)


def complete(
    runner: Runner,
    train: SearchSpace,
    solution: Solution,
    method: Method,
    before: list[Simulation],
    units: dict[str, str],
    seed: int,
    begin: float,
    uncertainty: Uncertainty | None = None,
) -> Result:
    """What a search on the training experiments means: test records, errors, intervals.

    Parameters
    ----------
    runner
        Where the simulations run that this still needs.
    train, solution
        The search's space and what it found there.
    method
        For what belongs to test records alone.
    before
        Every experiment at the start values.
    units
        Of the FMU's variables.
    seed, begin
        Of the run; `begin` is a reading of the monotonic clock.
    uncertainty
        The solution's; from its Jacobian alone if None.
    """
    problem = train.problem
    units = units | rows.coefficient_units(problem)
    test = make_space(problem, problem.indices("test"), train.estimates(solution.x))
    test_solution = _fit_test_records(runner, method, test, seed)
    known = train.estimates(solution.x)
    if test_solution is not None:
        known |= test.estimates(test_solution.x)
    after = simulate_all(runner, problem, known)
    solution = _whole(train, solution, method, after)
    if test_solution is not None:
        test_solution = _whole(test, test_solution, method, after)
    uncertainty = uncertainty or assess(train, solution)
    estimates = rows.estimates(train, solution, "train", units, uncertainty.intervals)
    estimates += rows.fixed(problem, units) + rows.derived(train, solution, units, uncertainty)
    if test_solution is not None:
        found = intervals(test, test_solution)
        estimates += rows.estimates(test, test_solution, "test", units, found)
    return Result(
        problem=problem,
        estimates=tuple(estimates),
        solution=solution,
        test_solution=test_solution,
        cost_before=_cost(problem, before),
        cost=_cost(problem, after),
        errors=output_errors(problem, before, after, units),
        simulations=tuple(after),
        evaluations=runner.evaluations,
        simulated=runner.simulations,
        failures=runner.failures,
        seconds=time.monotonic() - begin,
        constraints=rows.constraints(train, solution, before, after),
        front=rows.points(train, solution.others),
        uncertainty=uncertainty,
        before=_kept(before),
    )


def _kept(simulations: list[Simulation]) -> tuple[Simulation, ...]:
    """What is drawn of them later, if that is no burden."""
    paths = [s.outcome.trajectory for s in simulations]
    if sum(path.values.nbytes for path in paths if path is not None) > BEFORE_BYTES:
        return ()
    return tuple(replace(s, outcome=replace(s.outcome, residuals=None)) for s in simulations)


def refine(
    runner: Runner,
    train: SearchSpace,
    result: Result,
    method: Method,
    settings: UncertaintySettings,
    seed: int,
) -> Result:
    """Add the intervals that take refits: profiles and bootstrap."""
    solution = result.solution
    local = method if method.needs_residuals else LeastSquares()
    if not _accepts(local, train):
        local = method
    profiled = profiles(runner, train, solution, local, settings)
    drawn = None
    if settings.bootstrap:
        generator = np.random.default_rng(seed)
        drawn = bootstrap(runner, train, solution, local, settings, generator)
    return replace(result, profiles=profiled, bootstrap=drawn)


def simulate(
    problem: Problem, resources: Resources | None = None, values: dict[str, float] | None = None
) -> list[Simulation]:
    """Simulate every experiment once, at the start values or at values given by label."""
    problem.describe()
    with open_executor(problem, resources or Resources()) as executor:
        return simulate_all(Runner(executor), problem, values or {})


def check_search(
    problem: Problem, method: Method, settings: UncertaintySettings, multistart: Multistart
) -> SearchSpace:
    """The space of the training experiments, if it can be searched as is asked.

    Raises
    ------
    ProblemError
        If the method, the starts or the intervals do not suit the problem.
    """
    train = make_space(problem, problem.indices("train"))
    check_method(method, train)
    check_starts(train, multistart)
    check_profiles(train, settings)
    if settings.bootstrap:
        check_bootstrap(train)
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


def _fit_test_records(
    runner: Runner, method: Method, space: SearchSpace, seed: int
) -> Solution | None:
    """Estimate what belongs to test records alone. None if there is nothing to estimate."""
    if space.size == 0 or runner.interrupted:
        return None
    (solution,) = runner.run([SearchRequest("test", method, space, seed)])
    return solution


def simulate_all(runner: Runner, problem: Problem, known: dict[str, float]) -> list[Simulation]:
    """Every experiment once, at values given by label, else at the start values."""
    everything = tuple(range(len(problem.experiments)))
    space = make_space(problem, everything, known)
    name = "after" if known else "before"
    values = space.physical(space.start)
    outcomes = runner.simulate(values, everything, "trajectory", name, problem.effects)
    return [Simulation(e, outcome) for e, outcome in zip(everything, outcomes, strict=True)]


def _whole(
    space: SearchSpace, solution: Solution, method: Method, after: list[Simulation]
) -> Solution:
    """The solution with every residual at its point, where its search was sent reduced ones."""
    if solution.at is None or suited(space, method).wants == space.wants:
        return solution
    outcomes = tuple(replace(after[e].outcome, trajectory=None) for e in space.experiments)
    at = judge(space, solution.x, outcomes, solution.at.index)
    return replace(solution, cost=at.cost, at=at) if at.ok else solution


def _cost(problem: Problem, simulations: list[Simulation]) -> float:
    """The cost of the training experiments; NaN if one of them failed."""
    chosen = {s.experiment: s.outcome.residuals for s in simulations}
    space = make_space(problem, problem.indices("train"))
    residuals = [chosen[e] for e in space.experiments]
    known = [r for r in residuals if r is not None]
    if len(known) < len(residuals):
        return np.nan
    return problem.cost.value(np.concatenate(known), space.outputs)
