"""Points that are answered as they come, are dropped, and searches that are begun or given up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem
from support.shuffling_executor import ShufflingExecutor

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
from cluster_est.problem.search_space.space import SearchSpace, make_space
from cluster_est.running.records import Budget, SearchIteration
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task

SEEDS = st.integers(0, 2**32 - 1)


def problem(experiments: int = 2):
    parameters = [Parameter("a", 1.0), Parameter("x0", 0.5, per="experiment")]
    return unloaded_problem(parameters, experiments)


def answer(task: Task) -> Outcome:
    a, x0 = task.values
    if a < 0.0:
        return Outcome(task.id, Status.SOLVER_FAILURE, message="a is negative")
    return Outcome(task.id, Status.OK, np.array([a, x0 * a, 1.0 + task.experiment]))


def cost(a: float) -> float:
    """Of both experiments, at their starts of x0."""
    return 2.0 * (a**2 + (0.5 * a) ** 2) + 1.0 + 4.0


def points(space: SearchSpace, values: Sequence[float]) -> np.ndarray:
    x = np.tile(space.start, (len(values), 1))
    x[:, 0] = values
    return x


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
        found = yield Points(points(space, self.values[:asked]), "first", asynchronous=True)
        open_ = set(range(asked))
        while True:
            self.waits.append(len(found))
            self.seen += found
            open_ -= {at.index for at in found}
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
            found = yield Points(
                points(space, new),
                "more",
                Progress(asked, 0.0),
                asynchronous=True,
                drop=drop,
            )
        best = min(self.seen, key=lambda at: at.rank)
        return Solution(points(space, [self.values[best.index]])[0], best.cost, Ending.CONVERGED)


def request(method: Method, name: str = "search", experiments: tuple[int, ...] = (0, 1)):
    return SearchRequest(name, method, make_space(problem(), experiments))


VALUES = tuple(3.0 - 0.25 * i for i in range(12))


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 5), st.integers(1, 4))
def test_every_asynchronous_point_is_answered_once_with_its_own_number(seed, ahead, workers):
    method = Eager(VALUES, ahead)
    executor = ShufflingExecutor(answer, seed, workers)
    (solution,) = Runner(executor).run([request(method)])
    assert sorted(at.index for at in method.seen) == list(range(12))
    for at in method.seen:
        assert at.cost == pytest.approx(cost(VALUES[at.index]))
    assert min(method.waits) >= 1
    assert solution.cost == pytest.approx(cost(VALUES[-1]))
    assert len(executor.submitted) == 24


def test_an_answer_does_not_wait_for_the_slowest():
    """The first of three points, whose two tasks are the slowest, holds nothing up."""
    order: list[int] = []

    class Slow(ShufflingExecutor):
        def completed(self) -> list[Outcome]:
            self._queue.sort(key=lambda task: task.values[0] == VALUES[0])
            order.append(len(self._queue))
            task = self._queue.pop(0)
            return [answer(task)]

    method = Eager(VALUES, 3)
    Runner(Slow(answer)).run([request(method)])
    assert [at.index for at in method.seen][-1] == 0
    assert len(method.seen) == 12


@settings(max_examples=25)
@given(SEEDS, st.integers(2, 5), st.integers(1, 3))
def test_dropped_points_are_never_answered(seed, ahead, every):
    method = Eager(VALUES, ahead, drop_every=every)
    executor = ShufflingExecutor(answer, seed, 2)
    Runner(executor).run([request(method)])
    answered = [at.index for at in method.seen]
    assert sorted([*answered, *method.dropped]) == list(range(12))
    assert len(set(answered)) == len(answered)
    assert executor.waiting <= 4  # what had begun when the search ended


def test_what_has_not_begun_is_not_simulated():
    @dataclass
    class Regrets(Method):
        name: ClassVar[str] = "regrets"
        needs_residuals: ClassVar[bool] = False
        indices: list[int] = field(default_factory=list)

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            many = points(space, [1.0 + i for i in range(20)])
            found = yield Points(many, "many", asynchronous=True)
            self.indices += [at.index for at in found]
            rest = tuple(i for i in range(20) if i not in self.indices)
            found = yield Points(points(space, [0.5]), "one", asynchronous=True, drop=rest)
            self.indices += [at.index for at in found]
            return Solution(space.start, 0.0, Ending.CONVERGED)

    method = Regrets()
    executor = ShufflingExecutor(answer, 1, 2)
    runner = Runner(executor)
    runner.run([request(method)])
    assert method.indices[-1] == 20
    assert len(executor.submitted) == 42
    assert len(executor.answered) <= 14
    assert len(executor.cancelled) >= 30
    assert executor.waiting <= 2
    assert runner.evaluations == 21
    assert runner.simulations == len(executor.answered)


def test_a_point_that_another_search_wants_too_goes_on():
    @dataclass
    class Fickle(Method):
        name: ClassVar[str] = "fickle"
        needs_residuals: ClassVar[bool] = False

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            yield Points(points(space, [9.0, 5.0, 6.0, 7.0, 8.0]), "many", asynchronous=True)
            drop = (1, 2, 3, 4)
            yield Points(points(space, [4.0]), "one", asynchronous=True, drop=drop)
            return Solution(space.start, 0.0, Ending.CONVERGED)

    steady = Eager((5.0, 6.0, 7.0, 8.0), 4)
    for seed in range(20):
        steady = Eager((5.0, 6.0, 7.0, 8.0), 4)
        executor = ShufflingExecutor(answer, seed, 1)
        Runner(executor).run([request(Fickle(), "fickle"), request(steady, "steady")])
        assert sorted(at.index for at in steady.seen) == [0, 1, 2, 3]
        tasks = {(t.experiment, t.values.tobytes()) for t in executor.submitted}
        assert len(tasks) == len(executor.submitted)


@pytest.mark.parametrize("seed", range(10))
def test_a_dropped_point_may_be_asked_for_again(seed):
    @dataclass
    class Wavering(Method):
        name: ClassVar[str] = "wavering"
        needs_residuals: ClassVar[bool] = False
        found: list[Evaluation] = field(default_factory=list)

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            yield Points(points(space, [1.0, 2.0, 3.0, 4.0]), "ask", asynchronous=True)
            x = points(space, [1.0, 2.0, 3.0, 4.0])
            while len(self.found) < 4:
                got = yield Points(x, "again", asynchronous=True, drop=(0, 1, 2, 3))
                x = x[:0]
                self.found += got
            return Solution(space.start, 0.0, Ending.CONVERGED)

    method = Wavering()
    Runner(ShufflingExecutor(answer, seed, 2)).run([request(method)])
    assert sorted(at.index for at in method.found) == [4, 5, 6, 7]
    assert sorted(at.cost for at in method.found) == pytest.approx([cost(i) for i in (1, 2, 3, 4)])


def test_the_same_point_twice_in_a_request_is_simulated_once_and_answered_twice():
    @dataclass
    class Twice(Method):
        name: ClassVar[str] = "twice"
        needs_residuals: ClassVar[bool] = False
        found: list[Evaluation] = field(default_factory=list)

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            self.found += yield Points(points(space, [2.0, 3.0, 2.0]), "ask")
            self.found += yield Points(points(space, [2.0]), "again")
            return Solution(space.start, 0.0, Ending.CONVERGED)

    method = Twice()
    executor = ShufflingExecutor(answer, 0)
    Runner(executor).run([request(method)])
    assert [at.index for at in method.found] == [0, 1, 2, 3]
    assert [at.cost for at in method.found] == pytest.approx([cost(v) for v in (2, 3, 2, 2)])
    assert len(executor.submitted) == 4


def test_parameters_without_a_value_are_not_simulated():
    parameters = [Parameter("a", 1.0), Parameter("b", 0.0, expression="sqrt(a)")]
    space = make_space(unloaded_problem(parameters), (0,))

    @dataclass
    class Below(Method):
        name: ClassVar[str] = "below"
        needs_residuals: ClassVar[bool] = False
        found: list[Evaluation] = field(default_factory=list)

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            self.found += yield Points(np.array([[-1.0], [4.0], [np.inf]]), "ask")
            return Solution(space.start, 0.0, Ending.CONVERGED)

    method = Below()
    executor = ShufflingExecutor(answer, 0)
    Runner(executor).run([SearchRequest("search", method, space)])
    bad, good, infinite = method.found
    assert good.ok
    assert bad.reason == "not finite: parameter 'b' is nan, so nothing was simulated"
    assert infinite.reason == "not finite: parameter 'a' is inf, so nothing was simulated"
    assert len(executor.submitted) == 1


@pytest.mark.parametrize("method", [LeastSquares(), Eager(VALUES)], ids=lambda m: m.name)
def test_a_number_of_residuals_that_changes_is_a_failure(method):
    """A function of the user's may return more of them at some points, on one worker or another."""

    def changing(task: Task) -> Outcome:
        a, x0 = task.values
        return Outcome(task.id, Status.OK, np.array([a, x0 - 0.2, *([1.0] if a < 0.7 else [])]))

    recorded: list[Outcome] = []
    runner = Runner(
        ShufflingExecutor(changing), record=lambda origin, outcome: recorded.append(outcome)
    )
    (solution,) = runner.run([request(method)])
    assert solution.cost >= 2.0 * 0.7**2
    said = {o.message for o in recorded if not o.ok}
    assert said == {"there are 3 residuals but there were 2 at the first point"}
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
            (at,) = yield Points(points(space, [a]), "start", Progress(0, np.nan))
            if not at.ok:
                return Solution(space.start, np.nan, Ending.START_FAILED, at.reason)
            while a > self.low:
                iteration += 1
                a *= 0.5
                (at,) = yield Points(points(space, [a]), "step", Progress(iteration, at.cost))
            self.log.append(f"end {name}")
            x = points(space, [a])[0]
            return Solution(x, at.cost, Ending.CONVERGED, iterations=iteration, at=at)
        finally:
            self.log.append(f"close {name}")


def many(method: Method, starts: Sequence[float]) -> list[SearchRequest]:
    space = make_space(problem(), (0, 1))
    return [
        SearchRequest(f"start {i}", method, space.starting_at(points(space, [a])[0]))
        for i, a in enumerate(starts)
    ]


STARTS = (3.0, 0.5, 7.0, 1.0, 100.0, 0.3, 2.0, 9.0)


def summary(solutions: Sequence[Solution]) -> list[tuple[bytes, float, Ending, int]]:
    return [(s.x.tobytes(), s.cost, s.ending, s.iterations) for s in solutions]


REFERENCE = summary(Runner(ShufflingExecutor(answer)).run(many(Downhill(), STARTS)))


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 9), st.integers(1, 5))
def test_how_many_searches_are_under_way_changes_nothing(seed, at_once, workers):
    found = Runner(ShufflingExecutor(answer, seed, workers)).run(many(Downhill(), STARTS), at_once)
    assert summary(found) == REFERENCE


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
    method = Downhill()
    found = Runner(executor).run(many(method, STARTS), at_once, enough)
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


def test_failed_starts_are_solutions_like_others():
    found = Runner(ShufflingExecutor(answer)).run(many(Downhill(), (-1.0, 2.0)), 1)
    assert [s.ending for s in found] == [Ending.START_FAILED, Ending.CONVERGED]


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


@settings(max_examples=25)
@given(SEEDS, st.integers(0, 12))
def test_an_interrupt_ends_all_of_them(seed, when):
    def interrupt(call: int) -> None:
        if call == when:
            raise KeyboardInterrupt

    found = Runner(ShufflingExecutor(answer, seed, 2, interrupt)).run(many(Downhill(), STARTS), 2)
    assert len(found) == len(STARTS)
    assert {s.ending for s in found} <= {Ending.INTERRUPTED, Ending.CONVERGED}
    assert found[-1].ending is Ending.INTERRUPTED


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
    @dataclass
    class Repeats(Method):
        name: ClassVar[str] = "repeats"
        needs_residuals: ClassVar[bool] = False

        def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
            for _ in range(3):
                yield Points(points(space, [1.0]), "same", Progress(4, 2.0))
            yield Points(points(space, [1.0]), "silent")
            return Solution(space.start, 2.0, Ending.STALLED, iterations=4)

    noted = notes_of(lambda runner: runner.run([request(Repeats())]))
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
