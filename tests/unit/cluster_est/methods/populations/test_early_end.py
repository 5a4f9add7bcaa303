"""Points whose simulations end early change nothing that a population finds."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import FunctionExecutor, FunctionProblem, named

from cluster_est import Budget
from cluster_est.costs.robust import SoftL1
from cluster_est.methods import METHODS, Method
from cluster_est.methods.base import Solution
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task

NAMES = ["de", "pso", "ga"]
BEALE = replace(named("beale"), lower=(-4.5, -4.5), upper=(4.5, 4.5))
DENNIS = replace(named("brown dennis"), lower=(-30.0,) * 4, upper=(30.0,) * 4)


class EarlyExecutor(FunctionExecutor):
    """Ends whatever is above its bound, and counts."""

    ended = 0

    def _answer(self, task: Task) -> Outcome:
        outcome = super()._answer(task)
        if outcome.residuals is None or not float(np.sum(outcome.residuals**2)) > task.bound:
            return outcome
        self.ended += 1
        return Outcome(task.id, Status.ENDED_EARLY, message="its sum was above the bound")


def solve(problem: FunctionProblem, method: Method) -> tuple[Solution, Runner, int]:
    """The solution, who ran it and how many simulations ended early."""
    executor = EarlyExecutor(problem.residuals, problem.constraints)
    runner = Runner(executor, Budget(evaluations=600))
    (solution,) = runner.run([SearchRequest("test", method, problem.space(), 3)])
    return solution, runner, executor.ended


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("de", {}, BEALE),
        ("pso", {"population": 12}, DENNIS),
        ("pso", {"adaptive": True}, DENNIS),
        ("ga", {"population": 12}, BEALE),
    ],
)
def test_the_result_is_the_same(name, options, problem):
    whole, all_of_it, _ = solve(problem, METHODS[name](**options))
    early, runner, ended = solve(problem, METHODS[name](**options, early_end=True))
    assert ended > 100
    assert early.x.tobytes() == whole.x.tobytes()
    assert (early.cost, early.ending, early.message) == (whole.cost, whole.ending, whole.message)
    assert early.iterations == whole.iterations
    assert runner.evaluations == all_of_it.evaluations
    assert runner.failures == 0


@pytest.mark.parametrize("name", NAMES)
def test_no_bound_without_the_option_or_with_another_cost_or_constraints(name):
    robust = replace(BEALE, cost=SoftL1())
    held = replace(BEALE, constraints=lambda x: np.array([x[0] - 4.0]), equality=(False,))
    on = METHODS[name](early_end=True)
    for problem, method in ((BEALE, METHODS[name]()), (robust, on), (held, on)):
        assert solve(problem, method)[2] == 0
