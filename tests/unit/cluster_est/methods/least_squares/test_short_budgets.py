"""A budget of evaluations that ends a search: no Jacobian is for nothing."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.functions import FunctionExecutor, FunctionProblem, brown_dennis, rosenbrock

from cluster_est import Budget, LeastSquares
from cluster_est.errors import BudgetError
from cluster_est.methods.base import Ending, Solution
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.records import TaskOrigin
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome

VALLEY = FunctionProblem("rosenbrock", rosenbrock, (-1.2, 1.0), 0.0)
FOUR = FunctionProblem("brown dennis", brown_dennis, (25.0, 5.0, -5.0, -1.0), 85822.2)
SOME = 40
"""Budgets that end in the first steps, and as many that end in the last."""
JACOBIANS = ("jacobian", "jacobian_central")


def search(
    problem: FunctionProblem, method: LeastSquares, most: int | None, searches: int = 1
) -> tuple[list[Solution], list[str]]:
    """The solutions, and the purpose of each point that was simulated."""
    purposes: list[str] = []

    def record(origin: TaskOrigin, outcome: Outcome) -> None:
        del outcome
        purposes.append(origin.purpose)

    with FunctionExecutor(problem.residuals) as executor:
        runner = Runner(executor, Budget(evaluations=most), record)
        space = make_space(problem.problem(), (0,))
        rooms = [space.starting_at(space.start * (1.0 + 0.1 * i)) for i in range(searches)]
        requests = [SearchRequest(f"s{i}", method, room) for i, room in enumerate(rooms)]
        solutions = runner.run(requests)
    return solutions, purposes


@pytest.mark.parametrize("trials", [1, 4])
@pytest.mark.parametrize("problem", [VALLEY, FOUR], ids=lambda problem: problem.name)
def test_the_last_points_are_steps(problem, trials):
    method = LeastSquares(trials=trials)
    (free,), all_of_it = search(problem, method, None)
    size, costs, messages = len(problem.start), [], []
    budgets = range(2 + size, len(all_of_it))
    for most in (*budgets[:SOME], *budgets[max(SOME, len(budgets) - SOME) :]):
        (solution,), purposes = search(problem, method, most)
        costs.append(solution.cost)
        messages.append(solution.message)
        assert len(purposes) < most + trials
        if solution.ending is Ending.BUDGET:
            assert purposes[-1] not in JACOBIANS
        else:
            assert solution.ending.success
            assert solution.jacobian is not None
            assert solution.cost == pytest.approx(free.cost, rel=1e-6, abs=1e-12)
    assert messages.count("the budget had no room for better derivatives") >= 2 * size - 1
    assert costs[-1] == pytest.approx(free.cost, rel=1e-3, abs=1e-9)
    start = float(np.sum(problem.residuals(np.array(problem.start)) ** 2))
    assert all(cost < start for cost in costs)


def test_it_goes_on_with_the_last_jacobian():
    method = LeastSquares(trials=1)
    _, whole = search(FOUR, method, None)
    firsts = [i for i, purpose in enumerate(whole) if purpose == "jacobian"][4::4]
    steps = 0
    for first in firsts:
        (short,), purposes = search(FOUR, method, first + 4)  # the four points, and no step
        (before,), _ = search(FOUR, method, first)
        assert not set(purposes[first:]) & set(JACOBIANS)
        assert short.ending is before.ending is Ending.BUDGET
        assert short.cost <= before.cost
        steps += short.cost < before.cost
    assert steps > len(firsts) // 2


def test_searches_that_share_a_budget_end_within_it():
    solutions, purposes = search(FOUR, LeastSquares(), 60, searches=3)
    assert {solution.ending for solution in solutions} == {Ending.BUDGET}
    assert len(purposes) <= 60 + 3 * 4
    assert purposes[-1] not in JACOBIANS


def test_a_recipe_that_needs_whole_searches_is_refused_as_before():
    with FunctionExecutor(FOUR.residuals) as executor:
        runner = Runner(executor, Budget(evaluations=11), whole=True)
        space = make_space(FOUR.problem(), (0,))
        with pytest.raises(BudgetError):
            runner.run([SearchRequest("s", LeastSquares(), space)])
    assert runner.evaluations >= 11


def test_after_it_no_search_asks_for_more_than_it_must():
    with FunctionExecutor(FOUR.residuals) as executor:
        runner = Runner(executor, Budget(evaluations=12))
        space = make_space(FOUR.problem(), (0,))
        (first,) = runner.run([SearchRequest("s", LeastSquares(trials=1), space)])
        assert first.ending is Ending.BUDGET
        used = runner.evaluations
        runner.run([SearchRequest("t", LeastSquares(), space.starting_at(first.x))])
    assert runner.evaluations == used + 1
