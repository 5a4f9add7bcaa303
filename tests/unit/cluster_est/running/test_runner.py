"""The runner gives a search the same numbers whatever the executor does, and always an ending."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem
from support.scripted import Scripted, ask, ended
from support.shuffling_executor import ShufflingExecutor

from cluster_est import Budget, Parameter
from cluster_est.errors import BudgetError
from cluster_est.methods import Method
from cluster_est.methods.method import Ending, Evaluation, Progress, Search
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.resources import RunSnapshot, SearchIteration
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task

TIMES = np.array([0.0, 0.5, 2.0])
COUNT = 4
SEEDS = st.integers(0, 2**32 - 1)


def space_of(experiments: Sequence[int] = range(COUNT)) -> SearchSpace:
    """Decays of different sizes with one rate."""
    rate = Parameter("rate", 0.5, (0.0, 20.0))
    size = Parameter("size", 2.0, (-10.0, 10.0), per="experiment")
    return make_space(unloaded_problem([rate, size], COUNT), tuple(experiments))


def answer(task: Task) -> Outcome:
    """Rates above 8 fail."""
    rate, size = task.values
    if rate > 8.0:
        return Outcome(task.id, Status.SOLVER_FAILURE, message=f"experiment {task.experiment}")
    noise = 0.01 * np.cos(40.0 * TIMES + task.experiment)
    measured = (1.0 + task.experiment) * np.exp(-1.3 * TIMES) + noise
    return Outcome(task.id, Status.OK, measured - size * np.exp(-rate * TIMES))


def executor_of(seed: int = 0, before: Callable[[int], None] = lambda call: None):
    return ShufflingExecutor(answer, seed, before=before)


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
                self.answers.append((yield ask(space, rates, f"request {i}", Progress(i, np.nan))))
            return ended(space)
        finally:
            self.closed = True


def whole(method: Method, name: str = "search", experiments: Sequence[int] = range(COUNT)):
    return SearchRequest(name, method, space_of(experiments))


def bits(evaluations: list[Evaluation]) -> list[tuple[float, list[bytes | None]]]:
    return [
        (e.cost, [None if o.residuals is None else o.residuals.tobytes() for o in e.outcomes])
        for e in evaluations
    ]


@given(SEEDS)
def test_evaluations_come_in_the_order_of_points_and_experiments(seed: int) -> None:
    method = Script([[1.0, 3.0, 9.0], [2.0, 1.0]])
    Runner(executor_of(seed)).run([whole(method, experiments=[2, 0, 3])])
    for rates, evaluations in zip(method.requests, method.answers, strict=True):
        for rate, evaluation in zip(rates, evaluations, strict=True):
            for e, outcome in zip((2, 0, 3), evaluation.outcomes, strict=True):
                expected = answer(Task(0, e, np.array([rate, 2.0])))
                assert outcome.message == expected.message
                np.testing.assert_array_equal(outcome.residuals, expected.residuals)


def test_failures_reach_the_method_with_a_reason_and_no_cost() -> None:
    method = Script([[9.0, 1.0]])
    runner = Runner(executor_of())
    runner.run([whole(method)])
    bad, good = method.answers[0]
    assert not bad.ok
    assert np.isnan(bad.cost)
    assert bad.reason == "solver failure: experiment 0"
    assert good.ok
    assert good.cost == pytest.approx(np.sum(good.residuals**2))
    assert (runner.evaluations, runner.simulations, runner.failures) == (2, 8, 4)


def test_lines_of_all_searches_are_noted_while_they_run() -> None:
    lines: list[SearchIteration] = []
    seen: list[set[str]] = []
    executor = executor_of(before=lambda _: seen.append({line.search for line in lines}))
    requests = [whole(Script([[1.0], [2.0], [3.0]]), name) for name in ("one", "other")]
    Runner(executor, note=lines.append).run(requests)
    assert seen[0] == set()
    assert seen[-1] == {"one", "other"}


def test_searches_run_at_the_same_time() -> None:
    seen: list[str] = []
    requests = [whole(Script([[i + k / 10] for k in range(8)]), f"s{i}", [i]) for i in range(3)]
    Runner(executor_of(1), record=lambda origin, _: seen.append(origin.search)).run(requests)
    assert len(seen) == 24
    last_begins = max(seen.index(name) for name in ("s0", "s1", "s2"))
    first_ends = min(len(seen) - seen[::-1].index(name) for name in ("s0", "s1", "s2"))
    assert last_begins < first_ends


@given(SEEDS)
def test_repeated_points_are_not_simulated_twice(seed: int) -> None:
    methods = [Script([[1.0, 1.0, 2.0], [1.0], [2.0, 3.0]]), Script([[3.0], [1.0, 2.0]])]
    executor = executor_of(seed)
    runner = Runner(executor)
    runner.run([whole(method, str(i)) for i, method in enumerate(methods)])
    questions = [(task.experiment, task.values.tobytes()) for task in executor.submitted]
    assert len(set(questions)) == len(questions) == 3 * COUNT
    assert runner.evaluations == 9
    assert runner.simulations == 3 * COUNT
    first, second = (sum(method.answers, []) for method in methods)  # noqa: RUF017
    assert bits(first) == bits([first[0], first[0], second[2], first[0], second[2], second[0]])


def test_run_after_a_run_remembers_and_a_single_simulation_does_not() -> None:
    executor = executor_of()
    runner = Runner(executor)
    for _ in range(2):
        runner.run([whole(Script([[1.0, 2.0]]))])
    assert len(executor.submitted) == 2 * COUNT
    values = np.array([[1.0, 2.0], [9.0, 2.0]])
    outcomes = runner.simulate(values, [3, 1], "trajectory", "after")
    assert [o.ok for o in outcomes] == [True, False]
    assert outcomes[1].message == "experiment 1"
    assert [task.want for task in executor.submitted[-2:]] == ["trajectory"] * 2
    assert executor.waiting == 0


class TestBudget:
    def test_ends_a_search_with_its_best_point_so_far(self) -> None:
        method = Script([[5.0], [1.4, 9.0], [3.0], [2.0]])
        runner = Runner(executor_of(), Budget(evaluations=4))
        (solution,) = runner.run([whole(method)])
        assert solution.ending is Ending.BUDGET
        assert not solution.ending.success
        assert solution.x[0] == 1.4
        assert solution.cost == method.answers[1][0].cost
        assert runner.evaluations == 4
        assert method.closed

    def test_of_no_time_still_answers_the_first_request(self) -> None:
        method = Script([[1.0, 2.0], [3.0]])
        (solution,) = Runner(executor_of(), Budget(seconds=1e-9)).run([whole(method)])
        assert solution.ending is Ending.BUDGET
        assert len(method.answers) == 1
        costs = [at.cost for at in method.answers[0]]
        assert solution.x[0] == (1.0, 2.0)[int(np.argmin(costs))]

    def test_of_a_search_that_never_worked_ends_at_its_start_without_a_cost(self) -> None:
        request = whole(Script([[9.0], [10.0]]))
        (solution,) = Runner(executor_of(), Budget(evaluations=1)).run([request])
        np.testing.assert_array_equal(solution.x, request.space.start)
        assert np.isnan(solution.cost)

    def test_raises_in_a_whole_runner_when_it_cuts_a_search(self) -> None:
        method = Script([[5.0], [1.4, 9.0], [3.0], [2.0]])
        runner = Runner(executor_of(), Budget(evaluations=4), whole=True)
        with pytest.raises(BudgetError, match="used up after 4 evaluations"):
            runner.run([whole(method)])
        assert method.closed
        with pytest.raises(BudgetError):
            runner.run([whole(Script([[5.0]]))])

    def test_of_a_whole_runner_leaves_searches_that_it_did_not_cut(self) -> None:
        runner = Runner(executor_of(), Budget(evaluations=1), whole=True)
        (solution,) = runner.run([whole(Script([[5.0]]))])
        assert solution.ending is Ending.CONVERGED


def interrupt_at(call: int) -> Callable[[int], None]:
    def before(calls: int) -> None:
        if calls == call:
            raise KeyboardInterrupt

    return before


@given(SEEDS, st.integers(0, 12))
def test_interrupt_ends_all_searches_with_their_best_points(seed: int, call: int) -> None:
    short, long = Script([[1.0]]), Script([[5.0, 6.0]] + [[4.0 - k / 20] for k in range(20)])
    requests = [whole(short, "short", [0]), whole(long, "long", [1, 2])]
    solutions = Runner(executor_of(seed, interrupt_at(call))).run(requests)
    assert solutions[1].ending is Ending.INTERRUPTED
    assert solutions[0].ending is (Ending.CONVERGED if short.answers else Ending.INTERRUPTED)
    seen = [evaluation.cost for answers in long.answers for evaluation in answers]
    assert solutions[1].cost == min(seen) if seen else np.isnan(solutions[1].cost)
    assert short.closed
    assert long.closed


@given(SEEDS)
def test_simulations_after_an_interrupt_are_not_confused_with_those_left_over(seed: int) -> None:
    runner = Runner(executor_of(seed, interrupt_at(0)))
    runner.run([whole(Script([[1.0, 2.0, 3.0, 4.0]]))])
    outcomes = runner.simulate(np.array([[5.0, 2.0]]), [1], "residuals", "after")
    expected = answer(Task(0, 1, np.array([5.0, 2.0])))
    np.testing.assert_array_equal(outcomes[0].residuals, expected.residuals)


def test_display_shows_the_search_that_still_runs() -> None:
    shown: list[RunSnapshot] = []
    requests = [whole(Script([[1.0]]), "short", [0]), whole(Script([[2.0]] * 3), "long", [1])]
    runner = Runner(executor_of(), show=shown.append)
    runner.run(requests)
    assert {snapshot.search for snapshot in shown} <= {"short", "long"}
    assert shown[-1].simulations == runner.simulations == 2
    assert shown[-1].evaluations == 4
    assert all(0 <= s.busy <= s.workers == 3 and s.seconds >= 0.0 for s in shown)


def test_error_in_a_method_is_raised_and_the_others_are_closed() -> None:
    def broken(space: SearchSpace) -> Search:
        yield ask(space, [1.0])
        raise ZeroDivisionError("a bug")

    other = Script([[1.0], [2.0], [3.0]])
    with pytest.raises(ZeroDivisionError, match="a bug"):
        Runner(executor_of()).run([whole(other), whole(Scripted(broken), "broken")])
    assert other.closed
