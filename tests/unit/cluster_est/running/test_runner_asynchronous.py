"""Points that are answered as they come, are dropped, and searches that are begun or given up."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem
from support.scripted import Scripted, ask, at, ended
from support.shuffling_executor import ShufflingExecutor
from virtual_executor import VirtualExecutor

from cluster_est import Budget, Parameter
from cluster_est.methods import LeastSquares, Method
from cluster_est.methods.method import Ending, Evaluation, Points, Progress, Search, Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.resources import SearchIteration
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task

SEEDS = st.integers(0, 2**32 - 1)


PARAMETERS = [Parameter("a", 1.0), Parameter("x0", 0.5, per="experiment")]
SPACE = make_space(unloaded_problem(PARAMETERS, 2), (0, 1))


def answer(task: Task) -> Outcome:
    a, x0 = task.values
    if a < 0.0:
        return Outcome(task.id, Status.SOLVER_FAILURE, message="a is negative")
    return Outcome(task.id, Status.OK, np.array([a, x0 * a, 1.0 + task.experiment]))


def cost(a: float) -> float:
    """Of both experiments, at their starts of x0."""
    return 2.0 * (a**2 + (0.5 * a) ** 2) + 1.0 + 4.0


@dataclass
class Eager(Method):
    """Keeps `ahead` asynchronous points under way until it has asked for `values`."""

    values: tuple[float, ...]
    ahead: int = 3
    drop_every: int = 0
    seen: list[Evaluation] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)
    waits: list[int] = field(default_factory=list)
    name: ClassVar[str] = "eager"
    needs_residuals: ClassVar[bool] = False
    asynchronous: ClassVar[bool] = True

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        asked = min(self.ahead, len(self.values))
        found = yield ask(space, self.values[:asked], "first", asynchronous=True)
        open_ = set(range(asked))
        while True:
            self.waits.append(len(found))
            self.seen += found
            open_ -= {each.index for each in found}
            drop: tuple[int, ...] = ()
            if self.drop_every and open_ and len(self.seen) % self.drop_every == 0:
                drop = (max(open_),)
                self.dropped += drop
                open_ -= set(drop)
            more = min(self.ahead - len(open_), len(self.values) - asked)
            new = self.values[asked : asked + more]
            open_ |= set(range(asked, asked + more))
            asked += more
            if not open_:
                break
            progress = Progress(asked, 0.0)
            found = yield ask(space, new, "more", progress, asynchronous=True, drop=drop)
        best = min(self.seen, key=lambda each: each.rank)
        return Solution(at(space, [self.values[best.index]])[0], best.cost, Ending.CONVERGED)


def request(method: Method, name: str = "search"):
    return SearchRequest(name, method, SPACE)


def run(method: Method, executor: ShufflingExecutor, **more) -> list[Solution]:
    return Runner(executor, **more).run([request(method)])


VALUES = tuple(3.0 - 0.25 * i for i in range(12))


@settings(max_examples=50)
@given(SEEDS, st.integers(1, 5), st.integers(1, 4), st.integers(0, 3))
def test_every_point_is_answered_once_with_its_own_number_or_dropped(seed, ahead, workers, every):
    method = Eager(VALUES, ahead, every)
    executor = ShufflingExecutor(answer, seed, workers)
    (solution,) = run(method, executor)
    assert sorted([*(each.index for each in method.seen), *method.dropped]) == list(range(12))
    for each in method.seen:
        assert each.cost == pytest.approx(cost(VALUES[each.index]))
    assert min(method.waits) >= 1
    assert solution.cost == min(each.cost for each in method.seen)
    assert len(executor.submitted) == 24
    assert executor.waiting <= (2 * workers if every else 0)  # what had begun when it ended


def test_an_answer_does_not_wait_for_the_slowest():
    """The first of three points, whose two tasks are the slowest, holds nothing up."""
    executor = VirtualExecutor(
        lambda task: answer(task).residuals,
        lambda task, generator: 100.0 if task.values[0] == VALUES[0] else 1.0,
        workers=4,
    )
    method = Eager(VALUES, 3)
    run(method, executor)
    assert [each.index for each in method.seen][-1] == 0
    assert len(method.seen) == 12


def test_what_has_not_begun_is_not_simulated():
    indices: list[int] = []

    def regrets(space: SearchSpace) -> Search:
        found = yield ask(space, [1.0 + i for i in range(20)], "many", asynchronous=True)
        indices.extend(each.index for each in found)
        rest = tuple(i for i in range(20) if i not in indices)
        found = yield ask(space, [0.5], "one", asynchronous=True, drop=rest)
        indices.extend(each.index for each in found)
        return ended(space)

    executor = ShufflingExecutor(answer, 1, 2)
    runner = Runner(executor)
    runner.run([request(Scripted(regrets))])
    assert indices[-1] == 20
    assert len(executor.submitted) == 42
    assert len(executor.answered) <= 14
    assert len(executor.cancelled) >= 30
    assert executor.waiting <= 2
    assert runner.evaluations == 21
    assert runner.simulations == len(executor.answered)


@pytest.mark.parametrize("seed", range(20))
def test_a_point_that_another_search_wants_too_goes_on(seed):
    def fickle(space: SearchSpace) -> Search:
        yield ask(space, [9.0, 5.0, 6.0, 7.0, 8.0], "many", asynchronous=True)
        yield ask(space, [4.0], "one", asynchronous=True, drop=(1, 2, 3, 4))
        return ended(space)

    steady = Eager((5.0, 6.0, 7.0, 8.0), 4)
    executor = ShufflingExecutor(answer, seed, 1)
    Runner(executor).run([request(Scripted(fickle), "fickle"), request(steady, "steady")])
    assert sorted(each.index for each in steady.seen) == [0, 1, 2, 3]
    tasks = {(t.experiment, t.values.tobytes()) for t in executor.submitted}
    assert len(tasks) == len(executor.submitted)


@pytest.mark.parametrize("seed", range(10))
def test_a_dropped_point_may_be_asked_for_again(seed):
    values, found = [1.0, 2.0, 3.0, 4.0], []

    def wavering(space: SearchSpace) -> Search:
        yield ask(space, values, asynchronous=True)
        again = values
        while len(found) < 4:
            found.extend((yield ask(space, again, "again", asynchronous=True, drop=(0, 1, 2, 3))))
            again = []
        return ended(space)

    run(Scripted(wavering), ShufflingExecutor(answer, seed, 2))
    assert sorted(each.index for each in found) == [4, 5, 6, 7]
    assert sorted(each.cost for each in found) == pytest.approx([cost(i) for i in values])


def test_parameters_without_a_value_are_not_simulated():
    parameters = [Parameter("a", 1.0), Parameter("b", 0.0, expression="sqrt(a)")]
    found: list[Evaluation] = []

    def below(space: SearchSpace) -> Search:
        found.extend((yield Points(np.array([[-1.0], [4.0], [np.inf]]), "ask")))
        return ended(space)

    executor = ShufflingExecutor(answer)
    Runner(executor).run([Scripted(below).on(make_space(unloaded_problem(parameters), (0,)))])
    bad, good, infinite = found
    assert good.ok
    assert "parameter 'b' is nan" in bad.reason
    assert "parameter 'a' is inf" in infinite.reason
    assert len(executor.submitted) == 1


@pytest.mark.parametrize("method", [LeastSquares(), Eager(VALUES)], ids=lambda m: m.name)
def test_a_number_of_residuals_that_changes_is_a_failure(method):
    """A function of the user's may return more of them at some points, on one worker or another."""

    def changing(task: Task) -> Outcome:
        a, x0 = task.values
        return Outcome(task.id, Status.OK, np.array([a, x0 - 0.2, *([1.0] if a < 0.7 else [])]))

    recorded: list[Outcome] = []
    runner = Runner(ShufflingExecutor(changing), record=lambda _, each: recorded.append(each))
    (solution,) = runner.run([request(method)])
    assert solution.cost >= 2.0 * 0.7**2
    (said,) = {o.message for o in recorded if not o.ok}
    assert re.search("3 residuals.*at the first point there were 2", said)
    assert runner.failures == sum(not o.ok for o in recorded)


# Many searches.


@dataclass
class Downhill(Method):
    """Halves a from its start until it is below `low`; says so."""

    low: float = 0.1
    log: list[str] = field(default_factory=list)
    name: ClassVar[str] = "downhill"
    needs_residuals: ClassVar[bool] = False

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        name = f"{space.start[0]:g}"
        self.log.append(f"begin {name}")
        try:
            a, iteration = space.start[0], 0
            (found,) = yield ask(space, [a], "start", Progress(0, np.nan))
            if not found.ok:
                return Solution(space.start, np.nan, Ending.START_FAILED, found.reason)
            while a > self.low:
                iteration += 1
                a *= 0.5
                (found,) = yield ask(space, [a], "step", Progress(iteration, found.cost))
            self.log.append(f"end {name}")
            x = at(space, [a])[0]
            return Solution(x, found.cost, Ending.CONVERGED, iterations=iteration, at=found)
        finally:
            self.log.append(f"close {name}")


def many(method: Method, starts: Sequence[float]) -> list[SearchRequest]:
    points = enumerate(at(SPACE, starts))
    return [SearchRequest(f"start {i}", method, SPACE.starting_at(x)) for i, x in points]


STARTS = (3.0, 0.5, 7.0, 1.0, 100.0, 0.3, 2.0, 9.0)


def summary(solutions: Sequence[Solution]) -> list[tuple[bytes, float, Ending, int]]:
    return [(s.x.tobytes(), s.cost, s.ending, s.iterations) for s in solutions]


LINES: list[SearchIteration] = []
"""Of the tables of all searches."""
REFERENCE = summary(
    Runner(ShufflingExecutor(answer), note=LINES.append).run(many(Downhill(), STARTS))
)


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 9))
def test_no_more_searches_are_under_way_than_wanted_and_they_begin_in_order(seed, at_once):
    method = Downhill()
    Runner(ShufflingExecutor(answer, seed)).run(many(method, STARTS), at_once)
    under_way, most = 0, 0
    for line in method.log:
        under_way += {"begin": 1, "end": -1}.get(line.split()[0], 0)
        most = max(most, under_way)
    assert most <= at_once
    begun = [line.removeprefix("begin ") for line in method.log if line.startswith("begin")]
    assert begun == [f"{a:g}" for a in STARTS]


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 5), st.integers(1, 8), st.integers(1, 8))
def test_enough_sees_the_first_ones_in_order_whatever_ends_first(seed, workers, at_once, wanted):
    asked: list[int] = []

    def enough(solutions: Sequence[Solution]) -> bool:
        asked.append(len(solutions))
        assert summary(solutions) == REFERENCE[: len(solutions)]
        return len(solutions) >= wanted

    executor = ShufflingExecutor(answer, seed, workers)
    method, noted = Downhill(), list[SearchIteration]()
    found = Runner(executor, note=noted.append).run(many(method, STARTS), at_once, enough)
    names = [f"start {i}" for i in range(wanted)]
    assert sorted(map(repr, noted)) == sorted(repr(x) for x in LINES if x.search in names)
    assert asked == list(range(1, wanted + 1))
    assert summary(found) == REFERENCE[:wanted]
    begun = sum(line.startswith("begin") for line in method.log)
    assert sum(line.startswith("close") for line in method.log) == begun
    assert executor.waiting <= workers


def test_given_up_searches_leave_nothing_in_the_queue_and_nothing_behind():
    executor = ShufflingExecutor(answer, 3, 1)
    runner = Runner(executor)
    runner.run(many(Downhill(1e-9), STARTS), 8, lambda solutions: True)
    assert executor.cancelled
    again = runner.run(many(Downhill(), STARTS))
    assert summary(again) == REFERENCE


@settings(max_examples=50)
@given(SEEDS, st.integers(1, 40), st.integers(1, 5), st.integers(1, 8))
def test_a_budget_of_evaluations_cuts_the_same_searches_whatever_arrives_first(
    seed, evaluations, workers, at_once
):
    def cut(seed, workers):
        runner = Runner(ShufflingExecutor(answer, seed, workers), Budget(evaluations=evaluations))
        found = summary(runner.run(many(Downhill(), STARTS), at_once))
        return found, runner.evaluations

    found, reference = cut(seed, workers), cut(0, 1)
    assert repr(found) == repr(reference)  # a search that was not begun has no cost: NaN


def test_searches_that_were_not_begun_end_with_the_budget():
    runner = Runner(ShufflingExecutor(answer), Budget(evaluations=9))
    method = Downhill()
    found = runner.run(many(method, STARTS), 1)
    assert len(found) == len(STARTS)
    assert found[0].ending is Ending.CONVERGED
    assert [s.ending for s in found[3:]] == [Ending.BUDGET] * 5
    assert all(np.isnan(s.cost) for s in found[4:])
    assert sum(line.startswith("begin") for line in method.log) <= 3
    assert runner.evaluations <= 10


# Iteration tables.


def notes_of(run: Callable[[Runner], object], seed: int = 0) -> list[SearchIteration]:
    noted: list[SearchIteration] = []
    run(Runner(ShufflingExecutor(answer, seed), note=noted.append))
    return noted


@settings(max_examples=25)
@given(SEEDS)
def test_each_search_has_a_line_for_each_iteration_and_one_for_its_end(seed):
    noted = notes_of(lambda runner: runner.run(many(Downhill(), STARTS), 3), seed)
    for i, a in enumerate(STARTS):
        own = [n for n in noted if n.search == f"start {i}"]
        halvings = int(np.ceil(np.log2(a / 0.1))) if a > 0.1 else 0
        # nothing is known of the start before it has been evaluated
        assert [n.progress.iteration for n in own] == [*range(1, halvings + 1), halvings]
        assert [n.evaluations for n in own] == [*range(1, halvings + 1), halvings + 1]
        assert [n.progress.ending for n in own] == [""] * halvings + ["converged"]
        assert own[-1].progress.cost == pytest.approx(cost(a * 0.5**halvings))
        assert np.isnan(own[-1].progress.violation)


def test_an_unchanged_line_is_noted_once():
    def repeats(space: SearchSpace) -> Search:
        for _ in range(3):
            yield ask(space, [1.0], "same", Progress(4, 2.0))
        yield ask(space, [1.0], "silent")
        return Solution(space.start, 2.0, Ending.STALLED, iterations=4)

    noted = notes_of(lambda runner: runner.run([request(Scripted(repeats))]))
    assert [(n.progress.iteration, n.progress.ending) for n in noted] == [(4, ""), (4, "stalled")]


def test_the_end_says_how_far_from_the_constraints_it_is():
    parameters = [Parameter("a", 3.0), Parameter("x0", 0.5)]
    constrained = unloaded_problem(parameters, constraints=["a <= 0.25"])
    space = make_space(constrained, (0,))

    noted = notes_of(lambda r: r.run([SearchRequest("search", Downhill(1.0), space)]))
    assert noted[-1].progress.violation == pytest.approx(0.75 - 0.25)
    assert noted[-1].progress.ending == "converged"


def test_the_end_of_a_budget_is_noted_with_the_best_point():
    noted: list[SearchIteration] = []
    runner = Runner(ShufflingExecutor(answer), Budget(evaluations=3), note=noted.append)
    (solution,) = runner.run(many(Downhill(), (8.0,)))
    assert solution.ending is Ending.BUDGET
    assert solution.cost == pytest.approx(cost(2.0))
    assert noted[-1].progress.ending == "budget"
    assert noted[-1].progress.cost == solution.cost
    assert noted[-1].evaluations == 3
