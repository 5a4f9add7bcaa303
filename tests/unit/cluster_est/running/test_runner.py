"""The runner gives a search the same numbers whatever the executor does, and always an ending."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.errors import BudgetError
from cluster_est.executors import Executor
from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space.space import SearchSpace, make_space
from cluster_est.running.records import Budget, RunSnapshot, TaskOrigin
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Experiment, FloatArray, Model, Outcome, Output, Solver, Status, Task

TIMES = np.linspace(0.0, 2.0, 15)
COUNT = 4


def make_problem() -> Problem:
    """Decays of different sizes with one rate; rates above 8 fail."""
    experiments = tuple(
        Experiment(f"e{i}", 0.0, 2.0, (), (Output("y", TIMES, np.zeros(15)),)) for i in range(COUNT)
    )
    parameters = (
        Parameter("rate", 0.5, 0.0, 20.0),
        Parameter("size", 2.0, -10.0, 10.0, per="experiment"),
    )
    model = Model("none.fmu", b"", "model_exchange", Solver("rk4"), ("rate", "size"))
    return Problem(model, parameters, experiments)


def answer(task: Task) -> Outcome:
    rate, size = task.values
    if rate > 8.0:
        return Outcome(task.id, Status.SOLVER_FAILURE, message=f"experiment {task.experiment}")
    noise = 0.01 * np.cos(40.0 * TIMES + task.experiment)
    measured = (1.0 + task.experiment) * np.exp(-1.3 * TIMES) + noise
    return Outcome(task.id, Status.OK, measured - size * np.exp(-rate * TIMES))


class FakeExecutor(Executor):
    """Answers at once, some tasks at a time and in any order."""

    workers = 3

    def __init__(self, seed: int = 0, before: Callable[[int], None] = lambda call: None) -> None:
        self._generator = np.random.default_rng(seed)
        self._before = before
        self._queue: list[Task] = []
        self._calls = 0
        self.submitted: list[Task] = []

    def submit(self, tasks: Sequence[Task]) -> None:
        self._queue += tasks
        self.submitted += tasks

    def completed(self) -> list[Outcome]:
        self._calls += 1
        self._before(self._calls - 1)
        assert self._queue, "the runner waits for nothing"
        self._generator.shuffle(self._queue)
        count = int(self._generator.integers(1, len(self._queue) + 1))
        done, self._queue = self._queue[:count], self._queue[count:]
        return [answer(task) for task in done]

    def cancel(self, tasks: Collection[int]) -> list[int]:
        removed = [task.id for task in self._queue if task.id in tasks]
        self._queue = [task for task in self._queue if task.id not in removed]
        return removed

    @property
    def busy(self) -> int:
        return min(self.workers, len(self._queue))

    def close(self) -> None:
        self._queue = []


@dataclass
class Script(Method):
    """Asks for given rates, a list a request, and keeps the answers."""

    requests: list[list[float]]
    answers: list[list[Evaluation]] = field(default_factory=list)
    closed: bool = False

    needs_residuals: ClassVar[bool] = False

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        try:
            for i, rates in enumerate(self.requests):
                x = np.tile(space.start, (len(rates), 1))
                x[:, 0] = rates
                self.answers.append((yield Points(x, f"request {i}", Progress(i, np.nan))))
            return Solution(space.start, 0.0, Ending.CONVERGED)
        finally:
            self.closed = True


def whole(method: Method, name: str = "search", experiments: Sequence[int] = range(COUNT)):
    return SearchRequest(name, method, make_space(make_problem(), tuple(experiments)))


def bits(evaluations: list[Evaluation]) -> list[tuple[float, list[bytes | None]]]:
    return [
        (e.cost, [None if o.residuals is None else o.residuals.tobytes() for o in e.outcomes])
        for e in evaluations
    ]


def fitted(seed: int) -> tuple[list[tuple[bytes, float, Ending, int]], list[tuple]]:
    """Three searches at once on an executor of this mood: what they found and asked for."""
    asked: list[tuple] = []

    def record(origin: TaskOrigin, outcome: Outcome) -> None:
        asked.append(
            (origin.search, origin.evaluation, origin.task.experiment, origin.purpose,
             origin.task.values.tobytes())
        )  # fmt: skip

    requests = [
        whole(LeastSquares(), "all"),
        whole(LeastSquares(trials=1), "one by one", [0, 2]),
        whole(LeastSquares(differences="central"), "central", [1]),
    ]
    solutions = Runner(FakeExecutor(seed), record=record).run(requests)
    return [(s.x.tobytes(), s.cost, s.ending, s.iterations) for s in solutions], sorted(asked)


@given(st.integers(0, 2**32 - 1))
def test_results_do_not_depend_on_the_order_of_outcomes(seed: int) -> None:
    found, asked = fitted(seed)
    expected, expected_asked = fitted(0)
    assert found == expected
    assert {row[4] for row in asked} == {row[4] for row in expected_asked}
    assert all(ending.success for _, _, ending, _ in found)


@given(st.integers(0, 2**32 - 1))
def test_evaluations_come_in_the_order_of_points_and_experiments(seed: int) -> None:
    method = Script([[1.0, 3.0, 9.0], [2.0, 1.0]])
    Runner(FakeExecutor(seed)).run([whole(method, experiments=[2, 0, 3])])
    for rates, evaluations in zip(method.requests, method.answers, strict=True):
        tasks = [[Task(0, e, np.array([rate, 2.0])) for e in (2, 0, 3)] for rate in rates]
        for row, evaluation in zip(tasks, evaluations, strict=True):
            for task, outcome in zip(row, evaluation.outcomes, strict=True):
                assert outcome.message == answer(task).message
                np.testing.assert_array_equal(outcome.residuals, answer(task).residuals)


def test_failures_reach_the_method_with_a_reason_and_no_cost() -> None:
    method = Script([[9.0, 1.0]])
    runner = Runner(FakeExecutor())
    runner.run([whole(method)])
    bad, good = method.answers[0]
    assert not bad.ok
    assert np.isnan(bad.cost)
    assert bad.reason == "solver failure: experiment 0"
    assert good.ok
    assert good.cost == pytest.approx(np.sum(good.residuals**2))
    assert (runner.evaluations, runner.simulations, runner.failures) == (2, 8, 4)


def test_searches_run_at_the_same_time() -> None:
    seen: list[str] = []
    requests = [whole(Script([[i + k / 10] for k in range(8)]), f"s{i}", [i]) for i in range(3)]
    Runner(FakeExecutor(1), record=lambda origin, _: seen.append(origin.search)).run(requests)
    assert len(seen) == 24
    last_begins = max(seen.index(name) for name in ("s0", "s1", "s2"))
    first_ends = min(len(seen) - seen[::-1].index(name) for name in ("s0", "s1", "s2"))
    assert last_begins < first_ends


@given(st.integers(0, 2**32 - 1))
def test_repeated_points_are_not_simulated_twice(seed: int) -> None:
    methods = [Script([[1.0, 1.0, 2.0], [1.0], [2.0, 3.0]]), Script([[3.0], [1.0, 2.0]])]
    executor = FakeExecutor(seed)
    runner = Runner(executor)
    runner.run([whole(method, str(i)) for i, method in enumerate(methods)])
    questions = [(task.experiment, task.values.tobytes()) for task in executor.submitted]
    assert len(set(questions)) == len(questions) == 3 * COUNT
    assert runner.evaluations == 9
    assert runner.simulations == 3 * COUNT
    first, second = (sum(method.answers, []) for method in methods)  # noqa: RUF017
    assert bits(first) == bits([first[0], first[0], second[2], first[0], second[2], second[0]])


def test_run_after_a_run_remembers_and_a_single_simulation_does_not() -> None:
    executor = FakeExecutor()
    runner = Runner(executor)
    for _ in range(2):
        runner.run([whole(Script([[1.0, 2.0]]))])
    assert len(executor.submitted) == 2 * COUNT
    values = np.array([[1.0, 2.0], [9.0, 2.0]])
    outcomes = runner.simulate(values, [3, 1], "trajectory", "after")
    assert [o.ok for o in outcomes] == [True, False]
    assert outcomes[1].message == "experiment 1"
    assert [task.want for task in executor.submitted[-2:]] == ["trajectory"] * 2
    assert executor._queue == []


def test_budget_ends_a_search_with_its_best_point_so_far() -> None:
    method = Script([[5.0], [1.4, 9.0], [3.0], [2.0]])
    runner = Runner(FakeExecutor(), Budget(evaluations=4))
    (solution,) = runner.run([whole(method)])
    assert solution.ending is Ending.BUDGET
    assert not solution.ending.success
    assert solution.x[0] == 1.4
    assert solution.cost == method.answers[1][0].cost
    assert runner.evaluations == 4
    assert method.closed


def test_budget_of_no_time_still_answers_the_first_request() -> None:
    method = Script([[1.0, 2.0], [3.0]])
    (solution,) = Runner(FakeExecutor(), Budget(seconds=0.0)).run([whole(method)])
    assert solution.ending is Ending.BUDGET
    assert len(method.answers) == 1
    assert (
        solution.x[0]
        == min(((at.cost, x) for at, x in zip(method.answers[0], (1.0, 2.0), strict=True)))[1]
    )


def test_search_that_never_worked_ends_at_its_start_without_a_cost() -> None:
    request = whole(Script([[9.0], [10.0]]))
    (solution,) = Runner(FakeExecutor(), Budget(evaluations=1)).run([request])
    np.testing.assert_array_equal(solution.x, request.space.start)
    assert np.isnan(solution.cost)


def test_a_whole_runner_raises_when_the_budget_cuts_a_search() -> None:
    method = Script([[5.0], [1.4, 9.0], [3.0], [2.0]])
    runner = Runner(FakeExecutor(), Budget(evaluations=4), whole=True)
    with pytest.raises(BudgetError, match="used up after 4 evaluations"):
        runner.run([whole(method)])
    assert method.closed
    with pytest.raises(BudgetError):
        runner.run([whole(Script([[5.0]]))])


def test_a_whole_runner_keeps_searches_that_the_budget_did_not_cut() -> None:
    runner = Runner(FakeExecutor(), Budget(evaluations=1), whole=True)
    (solution,) = runner.run([whole(Script([[5.0]]))])
    assert solution.ending is Ending.CONVERGED


def test_an_interrupt_goes_through_a_whole_runner() -> None:
    method = Script([[5.0], [4.0]])
    with pytest.raises(KeyboardInterrupt):
        Runner(FakeExecutor(0, interrupt_at(0)), whole=True).run([whole(method)])
    assert method.closed


def interrupt_at(call: int) -> Callable[[int], None]:
    def before(calls: int) -> None:
        if calls == call:
            raise KeyboardInterrupt

    return before


@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_interrupt_ends_all_searches_with_their_best_points(seed: int, call: int) -> None:
    short, long = Script([[1.0]]), Script([[5.0, 6.0]] + [[4.0 - k / 20] for k in range(20)])
    requests = [whole(short, "short", [0]), whole(long, "long", [1, 2])]
    solutions = Runner(FakeExecutor(seed, interrupt_at(call))).run(requests)
    assert solutions[1].ending is Ending.INTERRUPTED
    assert solutions[0].ending is (Ending.CONVERGED if short.answers else Ending.INTERRUPTED)
    seen = [evaluation.cost for answers in long.answers for evaluation in answers]
    assert solutions[1].cost == min(seen) if seen else np.isnan(solutions[1].cost)
    assert short.closed
    assert long.closed


@given(st.integers(0, 2**32 - 1))
def test_simulations_after_an_interrupt_are_not_confused_with_those_left_over(seed: int) -> None:
    runner = Runner(FakeExecutor(seed, interrupt_at(0)))
    runner.run([whole(Script([[1.0, 2.0, 3.0, 4.0]]))])
    outcomes = runner.simulate(np.array([[5.0, 2.0]]), [1], "residuals", "after")
    expected = answer(Task(0, 1, np.array([5.0, 2.0])))
    np.testing.assert_array_equal(outcomes[0].residuals, expected.residuals)


def test_display_shows_the_search_that_still_runs() -> None:
    shown: list[RunSnapshot] = []
    requests = [whole(Script([[1.0]]), "short", [0]), whole(Script([[2.0]] * 3), "long", [1])]
    runner = Runner(FakeExecutor(), show=shown.append)
    runner.run(requests)
    assert {snapshot.search for snapshot in shown} <= {"short", "long"}
    assert shown[-1].simulations == runner.simulations == 2
    assert shown[-1].evaluations == 4
    assert all(0 <= s.busy <= s.workers == 3 and s.seconds >= 0.0 for s in shown)


def test_error_in_a_method_is_raised_and_the_others_are_closed() -> None:
    class Broken(Script):
        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            yield Points(space.start[None, :], "start")
            raise ZeroDivisionError("a bug")

    other = Script([[1.0], [2.0], [3.0]])
    with pytest.raises(ZeroDivisionError, match="a bug"):
        Runner(FakeExecutor()).run([whole(other), whole(Broken([]), "broken")])
    assert other.closed


def test_methods_draw_from_the_seed_of_their_request() -> None:
    drawn: list[FloatArray] = []

    class Random(Script):
        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            drawn.append(generator.random(3))
            return (yield from super().search(space, generator))

    space = make_space(make_problem(), (0,))
    requests = [
        SearchRequest(str(i), Random([[1.0]]), space, seed) for i, seed in enumerate((4, 4, 5))
    ]
    Runner(FakeExecutor()).run(requests)
    assert drawn[0].tolist() == drawn[1].tolist() != drawn[2].tolist()
