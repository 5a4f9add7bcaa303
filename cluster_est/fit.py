"""The recipe of a fit."""

from __future__ import annotations

import time

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Ending, Method, Solution
from cluster_est.methods.least_squares import LeastSquares
from cluster_est.problem import Problem
from cluster_est.resources import Resources, one_blas_thread, open_executor
from cluster_est.result import Estimate, Result, Simulation, output_errors
from cluster_est.runner import Record, Runner, SearchRequest, Show
from cluster_est.space import Space, make_space
from cluster_est.uncertainty import Interval, intervals
from workers.description import describe


def fit(
    problem: Problem,
    method: Method | None = None,
    resources: Resources | None = None,
    seed: int = 0,
    record: Record | None = None,
    show: Show | None = None,
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
    record, show
        Called for each simulation and whenever something came back; see `Runner`.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If model, experiments, method and machine do not fit together.
    """
    method = method or LeastSquares()
    resources = resources or Resources()
    begin = time.monotonic()
    description = problem.describe()
    train = make_space(problem, problem.indices("train"))
    check_method(method, train)
    units = {name: variable.unit for name, variable in description.variables.items()}
    with one_blas_thread(), open_executor(problem, resources) as executor:
        runner = Runner(executor, resources.budget, record, show)
        before = simulate_all(runner, problem, {})
        (solution,) = runner.run([SearchRequest("train", method, train, seed)])
        return complete(runner, train, solution, method, before, units, seed, begin)


def complete(
    runner: Runner,
    train: Space,
    solution: Solution,
    method: Method,
    before: list[Simulation],
    units: dict[str, str],
    seed: int,
    begin: float,
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
    """
    problem = train.problem
    units = units | coefficient_units(problem)
    test = make_space(problem, problem.indices("test"), train.estimates(solution.x))
    stopped = solution.ending is Ending.INTERRUPTED
    test_solution = None if stopped else _fit_test_records(runner, method, test, seed)
    known = train.estimates(solution.x)
    if test_solution is not None:
        known |= test.estimates(test_solution.x)
    after = simulate_all(runner, problem, known)
    estimates = _estimates(train, solution, "train", units) + _fixed(problem, units)
    if test_solution is not None:
        estimates += _estimates(test, test_solution, "test", units)
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
    )


def simulate(
    problem: Problem, resources: Resources | None = None, values: dict[str, float] | None = None
) -> list[Simulation]:
    """Simulate every experiment once, at the start values or at values given by label."""
    problem.describe()
    with open_executor(problem, resources or Resources()) as executor:
        return simulate_all(Runner(executor), problem, values or {})


def check_method(method: Method, space: Space) -> None:
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


def _fit_test_records(runner: Runner, method: Method, space: Space, seed: int) -> Solution | None:
    """Estimate what belongs to test records alone. None if there is nothing to estimate."""
    if space.size == 0:
        return None
    (solution,) = runner.run([SearchRequest("test", method, space, seed)])
    return solution


def coefficient_units(problem: Problem) -> dict[str, str]:
    """Units of the effects' coefficients, by "EFFECT.COEFFICIENT"; "" where the FMU names none."""
    if not problem.effects:
        return {}
    from workers.effects import units  # SymPy takes long to import
    from workers.effects.definition import define

    model = problem.model
    description = describe(model.name, model.archive)
    signals = tuple({s.variable: None for e in problem.experiments for s in e.signals})
    found: dict[str, str] = {}
    for effect in problem.effects:
        definition = define(effect, description, model.interface, signals)
        names = [f"{effect.name}.{c.name}" for c in definition.form.coefficients]
        texts = units.coefficient_units(definition, description)
        pairs = zip(names, texts, strict=True)
        found |= {name: "" if units.UNKNOWN in unit else unit for name, unit in pairs}
    return found


def simulate_all(runner: Runner, problem: Problem, known: dict[str, float]) -> list[Simulation]:
    """Every experiment once, at values given by label, else at the start values."""
    everything = tuple(range(len(problem.experiments)))
    space = make_space(problem, everything, known)
    name = "after" if known else "before"
    values = space.physical(space.start)
    outcomes = runner.simulate(values, everything, "trajectory", name, problem.effects)
    return [Simulation(e, outcome) for e, outcome in zip(everything, outcomes, strict=True)]


def _cost(problem: Problem, simulations: list[Simulation]) -> float:
    """The cost of the training experiments; NaN if one of them failed."""
    chosen = {s.experiment: s.outcome.residuals for s in simulations}
    space = make_space(problem, problem.indices("train"))
    residuals = [chosen[e] for e in space.experiments]
    known = [r for r in residuals if r is not None]
    if len(known) < len(residuals):
        return np.nan
    return problem.cost.value(np.concatenate(known), space.outputs)


def _estimates(
    space: Space, solution: Solution, role: str, units: dict[str, str]
) -> list[Estimate]:
    steps = solution.difference_steps
    found = intervals(space, solution)
    return [
        _estimate(space, solution, i, found[i], role, units, np.nan if steps is None else steps[i])
        for i in range(space.size)
    ]


def _estimate(
    space: Space,
    solution: Solution,
    i: int,
    interval: Interval,
    role: str,
    units: dict[str, str],
    difference_step: float,
) -> Estimate:
    unknown = space.unknowns[i]
    parameter = unknown.parameter
    _, _, scope = unknown.label.partition("[")
    return Estimate(
        label=unknown.label,
        parameter=parameter.name,
        variable=parameter.target,
        unit=parameter.unit or units.get(parameter.target, ""),
        scope=scope.removesuffix("]") or "shared",
        value=unknown.to_physical(float(solution.x[i])),
        start=unknown.start,
        lower=parameter.lower,
        upper=parameter.upper,
        scale=parameter.scale,
        at_bound=interval.at_bound,
        std_error=interval.std_error,
        lower95=interval.lower95,
        upper95=interval.upper95,
        difference_step=float(difference_step),
        estimated_on=role,
    )


def _fixed(problem: Problem, units: dict[str, str]) -> list[Estimate]:
    return [
        Estimate(
            label=p.name,
            parameter=p.name,
            variable=p.target,
            unit=p.unit or units.get(p.target, ""),
            scope="shared",
            value=p.start,
            start=p.start,
            lower=p.lower,
            upper=p.upper,
            scale=p.scale,
            at_bound="",
            std_error=np.nan,
            lower95=np.nan,
            upper95=np.nan,
            difference_step=np.nan,
            estimated_on="known",
        )
        for p in problem.parameters
        if p.fixed
    ]
