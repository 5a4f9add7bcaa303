"""Makes a result from a solution: test records, errors, tables and intervals."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.methods.method import Method, Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results import fit_tables as tables
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.output_errors import Simulation, output_errors
from cluster_est.results.result import Result
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest, assemble_evaluation, suited, with_priors
from cluster_est.running.sizes import with_sizes
from cluster_est.uncertainty import Uncertainty, assess, assess_held_out
from workers.fmu.variable import ModelVariable
from workers.messages import FloatArray

SAME_SIMULATION = 1e-5
"""Relative change, compared with the measured values, above which a repeated simulation differs.
Rounded values and other solver steps cause smaller changes."""
BEFORE_BYTES = 2**28
"""Largest size in bytes of all trajectories at the start values that are kept until the end of a
fit."""


def complete(
    runner: Runner,
    train: SearchSpace,
    solution: Solution,
    method: Method,
    before: list[Simulation],
    *,
    variables: Mapping[str, ModelVariable],
    seed: int,
    begin: float,
    steps: GuardedSteps,
    uncertainty: Uncertainty | None = None,
    segmented: Sequence[Simulation] = (),
) -> Result:
    """Make the result of a search on the training experiments.

    Parameters
    ----------
    runner
        Runs the remaining simulations.
    train, solution
        The search space of the training experiments, and the solution.
    method
        Method of the search for values that belong only to test records.
    before
        Simulations of all experiments at the start values.
    variables
        Variables of the FMU, for units and descriptions.
    seed, begin
        Random seed and start time of the run; `begin` is a reading of the monotonic clock.
    steps
        Stores sentences on steps that fail.
    uncertainty
        Uncertainty of the solution; None to compute it from the solution's Jacobian.
    segmented
        Simulations of experiments that are simulated in segments.
    """
    problem = train.problem
    units = {name: each.unit for name, each in variables.items()}
    units |= tables.coefficient_units(problem)
    test = make_space(problem, problem.indices("test"), train.estimates(solution.x))
    test_solution = None
    if test.size and not runner.interrupted:  # test records have their own unknowns
        test = with_sizes(runner, test)
        (test_solution,) = runner.run([SearchRequest("test", method, test, seed)])
    known = train.estimates(solution.x)
    if test_solution is not None:
        known |= test.estimates(test_solution.x)
    after = simulate_all(runner, problem, known, segmented)
    if differs := _not_repeated(train, solution, after):
        steps.failed.append(differs)
    solution = _whole(train, solution, method, after)
    if test_solution is not None:
        test_solution = _whole(test, test_solution, method, after)
    if uncertainty is None:
        whole = solution
        uncertainty = steps.assessed(train, whole, lambda: assess(train, whole))
    estimates = tables.estimates(train, solution, "train", units, uncertainty.intervals)
    estimates += tables.fixed(problem, units) + tables.derived(train, solution, units, uncertainty)
    if test_solution is not None:
        own, trained = test_solution, (train, solution, uncertainty)
        found = steps.assessed(
            test, own, lambda: assess_held_out(runner, (test, own), trained)
        ).intervals
        estimates += tables.estimates(test, own, "test", units, found)
    estimates = [
        replace(each, description=variables[each.variable].description)
        if each.variable in variables
        else each
        for each in estimates
    ]
    return Result(
        problem=problem,
        estimates=tuple(estimates),
        solution=solution,
        test_solution=test_solution,
        cost_before=_cost(train, train.start, before),
        cost=_cost(train, solution.x, after),
        errors=output_errors(problem, before, after, units),
        simulations=tuple(after),
        evaluations=runner.evaluations,
        simulated=runner.simulations,
        failures=runner.failures,
        seconds=time.monotonic() - begin,
        constraints=tables.constraints(train, solution, before, after),
        front=tables.points(train, solution.others),
        uncertainty=uncertainty,
        before=_kept(before),
        seed=seed,
    )


def _kept(simulations: list[Simulation]) -> tuple[Simulation, ...]:
    """Return the simulations for later plots; () if they need too much memory."""
    paths = [s.outcome.trajectory for s in simulations]
    if sum(path.values.nbytes for path in paths if path is not None) > BEFORE_BYTES:
        return ()
    return tuple(replace(s, outcome=replace(s.outcome, residuals=None)) for s in simulations)


def simulate_all(
    runner: Runner,
    problem: Problem,
    known: dict[str, float],
    segmented: Sequence[Simulation] = (),
) -> list[Simulation]:
    """Simulate each experiment once, with given values by label and other start values.

    Experiments in `segmented` are not simulated again.
    """
    there = {each.experiment: each for each in segmented}
    missing = [e for e in range(len(problem.experiments)) if e not in there]
    space = make_space(problem, tuple(range(len(problem.experiments))), known)
    name = "after" if known else "before"
    values = space.physical(space.start)[missing]
    outcomes = runner.simulate(values, missing, "trajectory", name, problem.effects)
    there |= {e: Simulation(e, outcome) for e, outcome in zip(missing, outcomes, strict=True)}
    return [there[e] for e in range(len(problem.experiments))]


def _not_repeated(space: SearchSpace, solution: Solution, after: list[Simulation]) -> str:
    """Return a sentence if a second simulation at the solution gives other results, or ""."""
    found = None if solution.at is None else solution.at.residuals
    outcomes = [with_priors(space, solution.x, i, after[e].outcome) for i, e in
                enumerate(space.experiments)]  # fmt: skip
    known = [outcome.residuals for outcome in outcomes if outcome.residuals is not None]
    again = np.concatenate([np.zeros(0), *known])
    if found is None or found.shape != again.shape or not np.isfinite(found).all():
        return ""
    outputs = [o for e in space.experiments for o in space.problem.experiments[e].outputs]
    sizes = [np.linalg.norm(again), *(np.linalg.norm(o.values / o.sigmas) for o in outputs)]
    change, size = float(np.linalg.norm(again - found)), float(np.linalg.norm(sizes))
    if not change > SAME_SIMULATION * size:
        return ""
    return (
        "when the simulation was repeated with the same values, the outputs differed by a fraction "
        f"of {change / size:.1g} of their size: either the FMU depends on more than its inputs and "
        "parameters, such as its process or a clock, or it is so sensitive to its parameters that "
        "rounding matters; check the FMU with cluster-est check"
    )


def _whole(
    space: SearchSpace, solution: Solution, method: Method, after: list[Simulation]
) -> Solution:
    """Return the solution with all residuals, if its search only received reduced residuals."""
    if solution.at is None or suited(space, method).wants == space.wants:
        return solution
    bare = [replace(after[e].outcome, trajectory=None) for e in space.experiments]
    outcomes = tuple(with_priors(space, solution.x, e, each) for e, each in enumerate(bare))
    at = assemble_evaluation(space, solution.x, outcomes, solution.at.index)
    return replace(solution, cost=at.cost, at=at) if at.ok else solution


def _cost(train: SearchSpace, x: FloatArray, simulations: list[Simulation]) -> float:
    """Return the cost of the training experiments and priors at x; NaN if a simulation failed."""
    chosen = {s.experiment: s.outcome for s in simulations}
    outcomes = [with_priors(train, x, i, chosen[e]) for i, e in enumerate(train.experiments)]
    known = [outcome.residuals for outcome in outcomes if outcome.residuals is not None]
    if len(known) < len(outcomes):
        return np.nan
    return train.problem.cost.value(np.concatenate(known), train.outputs)
