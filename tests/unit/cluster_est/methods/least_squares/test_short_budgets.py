"""A budget of evaluations that ends a search: no Jacobian is for nothing."""

import numpy as np
import pytest
from support.problems.functions import ROSENBROCK, FunctionExecutor, FunctionProblem, named

from cluster_est import Budget, LeastSquares
from cluster_est.methods.base import Ending, Solution
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

FOUR = named("brown dennis")
FIRST, LAST = 8, 24
"""How many budgets that end in the first steps, and in the last."""
JACOBIANS = ("jacobian", "jacobian_central")
ONE_TRIAL = LeastSquares(trials=1)


def search(
    problem: FunctionProblem, method: LeastSquares, most: int | None, searches: int = 1
) -> tuple[list[Solution], list[str]]:
    """The solutions, and the purpose of each point that was simulated."""
    purposes: list[str] = []
    runner = Runner(
        FunctionExecutor(problem.residuals),
        Budget(evaluations=most),
        lambda origin, _: purposes.append(origin.purpose),
    )
    space = problem.space()
    rooms = [space.starting_at(space.start * (1.0 + 0.1 * i)) for i in range(searches)]
    requests = [SearchRequest(f"s{i}", method, room) for i, room in enumerate(rooms)]
    return runner.run(requests), purposes


@pytest.mark.parametrize("trials", [1, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("problem", [ROSENBROCK, FOUR], ids=lambda problem: problem.name)
def test_the_last_points_are_steps(problem, trials):
    method = LeastSquares(trials=trials)
    (free,), all_of_it = search(problem, method, None)
    size, costs, messages = len(problem.start), [], []
    budgets = range(2 + size, len(all_of_it))
    for most in (*budgets[:FIRST], *budgets[-LAST:]):
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
    _, whole = search(FOUR, ONE_TRIAL, None)
    firsts = [i for i, purpose in enumerate(whole) if purpose == "jacobian"][4::8]
    steps = 0
    for first in firsts:
        (short,), purposes = search(FOUR, ONE_TRIAL, first + 4)  # the four points, and no step
        (before,), _ = search(FOUR, ONE_TRIAL, first)
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


def test_after_it_no_search_asks_for_more_than_it_must():
    runner = Runner(FunctionExecutor(FOUR.residuals), Budget(evaluations=12))
    (first,) = runner.run([SearchRequest("s", ONE_TRIAL, FOUR.space())])
    assert first.ending is Ending.BUDGET
    used = runner.evaluations
    runner.run([SearchRequest("t", LeastSquares(), FOUR.space().starting_at(first.x))])
    assert runner.evaluations == used + 1
