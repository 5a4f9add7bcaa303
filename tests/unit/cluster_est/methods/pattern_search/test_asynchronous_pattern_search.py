"""Asynchronous pattern search: what it finds in whatever order simulations end, and how soon."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.constrained import CONSTRAINED
from support.problems.functions import PROBLEMS, FunctionExecutor, FunctionProblem, rosenbrock
from support.problems.rough import ROUGH
from support.shuffling_executor import ShufflingExecutor
from virtual_executor import VirtualExecutor

from cluster_est.methods.base import Ending, Method, Solution
from cluster_est.methods.pattern_search.asynchronous import AsynchronousPatternSearch
from cluster_est.methods.pattern_search.method import PatternSearch
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

METHOD = AsynchronousPatternSearch()
OTHER_MINIMA = {"freudenstein roth": 48.98425, "hs15": 360.379767}
"""Local minima, as published with these problems: the order decides which one is found."""


def solve(problem: FunctionProblem, executor, method: Method = METHOD, seed: int = 0) -> Solution:
    space = make_space(problem.problem(), (0,))
    return Runner(executor).run([SearchRequest("test", method, space, seed)])[0]


def moody(problem: FunctionProblem, seed: int, workers: int) -> ShufflingExecutor:
    answers = FunctionExecutor(problem.residuals, problem.constraints)
    return ShufflingExecutor(answers._answer, seed, workers)


def is_minimum(problem: FunctionProblem, cost: float, tolerance: float) -> bool:
    minima = problem.minimum, OTHER_MINIMA.get(problem.name, problem.minimum)
    return any(cost == pytest.approx(m, rel=tolerance, abs=tolerance) for m in minima)


def sometimes_slow(task, generator) -> float:
    return 10.0 if generator.random() < 0.1 else 1.0


def virtual(problem: FunctionProblem, seed: int, workers: int) -> VirtualExecutor:
    constraints = problem.constraints
    return VirtualExecutor(
        lambda task: problem.residuals(task.values),
        sometimes_slow,
        workers,
        None if constraints is None else lambda task: constraints(task.values),
        seed,
    )


@pytest.mark.parametrize(("make", "workers"), [(moody, 3), (virtual, 8)])
class TestAnyOrder:
    @pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
    def test_finds_the_minimum(self, problem, make, workers):
        solution = solve(problem, make(problem, 1, workers))
        assert solution.ending is Ending.CONVERGED
        assert is_minimum(problem, solution.cost, 1e-6)

    @pytest.mark.parametrize("problem", CONSTRAINED, ids=lambda p: p.name)
    def test_finds_the_constrained_minimum(self, problem, make, workers):
        solution = solve(problem, make(problem, 2, workers))
        assert solution.at.feasible
        assert is_minimum(problem, solution.cost, 1e-5)

    @pytest.mark.parametrize(("problem", "above"), ROUGH, ids=lambda p: getattr(p, "name", ""))
    def test_finds_the_minimum_of_a_rough_cost(self, problem, above, make, workers):
        solution = solve(problem, make(problem, 3, workers))
        assert solution.cost <= problem.minimum + above


def test_never_asks_for_a_point_twice_nor_leaves_the_bounds():
    problem = next(p for p in PROBLEMS if p.name == "bard bounded")
    executor = moody(problem, 0, 3)
    solve(problem, executor)
    points = np.array([task.values for task in executor.submitted])
    taken_back = set(executor.cancelled)
    kept = [t.values.tobytes() for t in executor.submitted if t.id not in taken_back]
    assert len(set(kept)) == len(kept)
    assert (points >= problem.lower).all()
    assert (points <= problem.upper).all()


def test_points_that_are_not_wanted_any_more_are_taken_back():
    executor = moody(PROBLEMS[0], 0, 2)
    solve(PROBLEMS[0], executor, AsynchronousPatternSearch(outstanding=12))
    assert len(executor.cancelled) > 10
    assert executor.waiting == 0


@pytest.mark.parametrize("outstanding", [1, 3, 20])
def test_any_number_may_be_outstanding(outstanding):
    method = AsynchronousPatternSearch(outstanding=outstanding)
    solution = solve(PROBLEMS[3], moody(PROBLEMS[3], 0, 4), method)
    assert solution.cost == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("make", [moody, virtual])
def test_points_that_fail_are_worse_than_any(make):
    def walled(x):
        return rosenbrock(x) if x[1] > -2.0 and x[0] < 1.05 else np.full(2, np.nan)

    walled_problem = FunctionProblem("walled", walled, (-1.2, 1.0), 0.0)
    solution = solve(walled_problem, make(walled_problem, 0, 4))
    assert solution.cost == pytest.approx(0.0, abs=1e-5)


def test_a_start_that_fails():
    broken = FunctionProblem("broken", lambda x: np.array([np.nan]), (1.0,), 0.0)
    assert solve(broken, moody(broken, 0, 2)).ending is Ending.START_FAILED


def test_the_limit_of_iterations():
    solution = solve(
        PROBLEMS[0], moody(PROBLEMS[0], 0, 2), AsynchronousPatternSearch(max_iterations=3)
    )
    assert solution.ending is Ending.MAX_ITERATIONS


def chain(x):
    """A valley through eight unknowns."""
    return np.concatenate([3.0 * (x[1:] - x[:-1] ** 2), 1.0 - x])


CHAIN = FunctionProblem("chain", chain, (0.5,) * 8, 0.0)


class ReachedError(Exception):
    """A cost that was aimed at."""


def time_to(target: float, method: Method, seed: int, workers: int) -> float:
    """Virtual seconds until a simulation ends whose cost is below a target."""

    def residuals(task):
        found = chain(task.values)
        if found @ found < target:
            raise ReachedError
        return found

    executor = VirtualExecutor(residuals, sometimes_slow, workers, seed=seed)
    with pytest.raises(ReachedError):
        solve(CHAIN, executor, method, seed)
    return executor.now


@pytest.mark.parametrize("step", ["quadratic", "none"])
def test_is_sooner_where_one_simulation_in_ten_takes_ten_times_longer(step):
    methods = PatternSearch(search_step=step), AsynchronousPatternSearch(search_step=step)
    together, as_they_come = (
        np.median([time_to(1e-3, method, seed, workers=8) for seed in range(5)])
        for method in methods
    )
    assert as_they_come < 0.8 * together


def test_a_poll_in_virtual_time_takes_as_long_as_its_slowest_round():
    """The clock itself: 16 points of 1 s on 8 workers take 2 s, after the start's 1 s."""
    executor = VirtualExecutor(lambda task: task.values, lambda task, generator: 1.0, 8)
    plain = FunctionProblem("plain", lambda x: x, (1.0,) * 8, 0.0)
    solve(plain, executor, PatternSearch(search_step="none", max_iterations=1))
    assert executor.now == 3.0
    assert executor.busy_share == pytest.approx((1 + 16) / (8 * 3.0))
