"""Points whose simulations end early change nothing that a population finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import FunctionExecutor, FunctionProblem, beale, brown_dennis

from cluster_est import Budget
from cluster_est.costs.robust import SoftL1
from cluster_est.methods import METHODS
from cluster_est.methods.base import Solution
from cluster_est.methods.populations.method import PopulationMethod
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task

NAMES = ["de", "pso", "ga"]
PROBLEMS = [
    FunctionProblem("beale", beale, (1.0, 1.0), 0.0, (-4.5, -4.5), (4.5, 4.5)),
    FunctionProblem(
        "brown dennis", brown_dennis, (25.0, 5.0, -5.0, -1.0), 85822.2,
        (-30.0,) * 4, (30.0,) * 4,
    ),
]  # fmt: skip


class EarlyExecutor(FunctionExecutor):
    """Ends whatever is above its bound, and counts."""

    ended = 0

    def _answer(self, task: Task) -> Outcome:
        outcome = super()._answer(task)
        if outcome.residuals is None or not float(np.sum(outcome.residuals**2)) > task.bound:
            return outcome
        self.ended += 1
        return Outcome(task.id, Status.ENDED_EARLY, message="its sum was above the bound")


def solve(
    problem: FunctionProblem, method: PopulationMethod, executor: type[FunctionExecutor]
) -> tuple[Solution, Runner, FunctionExecutor]:
    opened = executor(problem.residuals, problem.constraints, 1)
    with opened:
        runner = Runner(opened, Budget(evaluations=600))
        space = make_space(problem.problem(), (0,))
        (solution,) = runner.run([SearchRequest("test", method, space, 3)])
    return solution, runner, opened


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda problem: problem.name)
@pytest.mark.parametrize("options", [{}, {"population": 12}])
@pytest.mark.parametrize("name", NAMES)
def test_the_result_is_the_same(name, options, problem):
    whole, all_of_it, _ = solve(problem, METHODS[name](**options), EarlyExecutor)
    early, runner, executor = solve(
        problem, METHODS[name](**options, early_end=True), EarlyExecutor
    )
    assert executor.ended > 100
    assert early.x.tobytes() == whole.x.tobytes()
    assert (early.cost, early.ending, early.message, early.iterations) == (
        whole.cost,
        whole.ending,
        whole.message,
        whole.iterations,
    )
    assert runner.evaluations == all_of_it.evaluations
    assert runner.failures == 0


def test_an_adaptive_swarm_finds_the_same():
    method = METHODS["pso"](adaptive=True)
    whole, _, _ = solve(PROBLEMS[1], method, EarlyExecutor)
    early, _, executor = solve(PROBLEMS[1], replace(method, early_end=True), EarlyExecutor)
    assert executor.ended > 100
    assert early.x.tobytes() == whole.x.tobytes()


@pytest.mark.parametrize("name", NAMES)
def test_no_bound_without_the_option_or_with_another_cost_or_constraints(name):
    robust = replace(PROBLEMS[0], cost=SoftL1())
    held = replace(PROBLEMS[0], constraints=lambda x: np.array([x[0] - 4.0]), equality=(False,))
    on = METHODS[name](early_end=True)
    for problem, method in ((PROBLEMS[0], METHODS[name]()), (robust, on), (held, on)):
        _, _, executor = solve(problem, method, EarlyExecutor)
        assert executor.ended == 0
