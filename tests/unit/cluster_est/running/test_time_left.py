"""How long what is under way still takes, as a display is told, on workers with virtual clocks."""

from collections.abc import Sequence

import numpy as np
import pytest
from support.problems.unloaded import unloaded_problem
from support.scripted import Scripted, ask, ended
from virtual_executor import VirtualExecutor

from cluster_est import Budget, Parameter
from cluster_est.methods import DifferentialEvolution, Method, PatternSearch
from cluster_est.methods.method import GivenPoints, Search
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.resources import RunSnapshot
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

FEW_POINTS = np.arange(1.0, 21.0)[:, None]
MANY_POINTS = np.arange(101.0, 141.0)[:, None]


def shown(
    methods: Sequence[Method],
    *,
    experiments: int = 1,
    workers: int = 1,
    seconds: float = 1.0,
    **how: Budget | int,
) -> list[RunSnapshot]:
    """What a display is told of searches whose simulations take so many seconds each."""
    problem = unloaded_problem([Parameter("a", 1.0, (-500.0, 500.0))], experiments)
    space = make_space(problem, tuple(range(experiments)))
    executor = VirtualExecutor(lambda task: task.values, lambda *_: seconds, workers)
    snapshots: list[RunSnapshot] = []
    budget, at_once = how.get("budget"), how.get("at_once")
    runner = Runner(executor, budget, show=snapshots.append, clock=lambda: executor.now)  # type: ignore[arg-type]
    requests = [SearchRequest(str(i), method, space) for i, method in enumerate(methods)]
    runner.run(requests, at_once)  # type: ignore[arg-type]
    return snapshots


def left_after(seconds: float, snapshots: Sequence[RunSnapshot]) -> float:
    return next(each.left for each in snapshots if each.seconds == seconds)


def asking(length: int, points: int = 1, first: float = 1.0) -> Scripted:
    """So many requests of points that nobody else asks for."""

    def steps(space: SearchSpace) -> Search:
        for i in range(length):
            yield ask(space, first + points * i + np.arange(points))
        return ended(space)

    return Scripted(steps)


def test_given_points_tell_how_many_are_evaluated() -> None:
    first, *others, _ = shown([GivenPoints(MANY_POINTS, "look")])
    assert np.isnan(first.left)  # a fortieth tells too little
    assert all(each.left == pytest.approx(40.0 - each.seconds) for each in others)


def test_generations_count_as_far_as_their_points_are_evaluated() -> None:
    few = shown([DifferentialEvolution(population=8, max_generations=5)])
    for each in few[2:-1]:  # after a twentieth
        done = (each.evaluations - each.busy - each.waiting) / (5 * 8)
        assert each.left == pytest.approx(each.seconds * (1.0 - done) / done)
    many = shown([DifferentialEvolution(population=8, max_generations=30)])
    assert all(np.isnan(each.left) for each in many[:-1])


def test_iterations_tell_where_they_are_few() -> None:
    few = shown([PatternSearch(max_iterations=10)])
    some = [each for each in few[:-1] if each.progress.iteration]
    assert len(some) > 5
    for each in some:
        done = each.progress.iteration / 10.0
        assert each.left == pytest.approx(each.seconds * (1.0 - done) / done)
        assert each.at_most
    assert all(np.isnan(each.left) for each in shown([PatternSearch()])[:-1])


def test_the_shares_of_several_searches_are_averaged() -> None:
    both = [GivenPoints(points, "look") for points in (FEW_POINTS, MANY_POINTS)]
    # all of one and a half of the other
    assert left_after(40.0, shown(both)) == pytest.approx(40.0 * 0.25 / 0.75)
    assert np.isnan(left_after(10.0, shown([both[0], PatternSearch()])))


@pytest.mark.parametrize(
    ("budget", "expected"),
    [
        # 16 of 40 simulations in 90 s, and 4 workers half way in others: 18 in all, 5 s each.
        # Two simulations a point; the last request goes beyond by half of its four points.
        (Budget(evaluations=30), 5.0 * (22.0 + 2.0 * (10.0 + 2.0))),
        (Budget(evaluations=20), 5.0 * 22.0),
        (Budget(evaluations=30, seconds=400.0), 230.0),
        (Budget(evaluations=30, seconds=300.0), 210.0),
        (Budget(), np.nan),
    ],
)
def test_the_sooner_limit_of_a_budget_counts(budget: Budget, expected: float) -> None:
    searches = [asking(3, points=4, first=100.0 * i - 200.0) for i in range(5)]
    found = shown(searches, experiments=2, workers=4, seconds=22.5, budget=budget)
    assert left_after(90.0, found) == pytest.approx(expected, nan_ok=True)


def test_searches_that_have_ended_tell_the_lengths_of_the_others() -> None:
    searches = [asking(n, first=60.0 * i - 300.0) for i, n in enumerate((10, 20, 30, 50, 1, 1))]
    found = shown(searches, at_once=1)
    assert all(np.isnan(each.left) for each in found if each.seconds < 60.0)  # two tell nothing
    for asked, of_this, of_a_new_one in (
        # survival by Kaplan and Meier: 3/4 after 10, 3/8 after 20, none after 30
        (15, (5.0 + 15.0) / 2.0, 0.25 * 10.0 + 0.375 * 20.0 + 0.375 * 30.0),
        (35, 0.0, 0.25 * (10.0 + 20.0 + 30.0 + 35.0)),
    ):
        done = 10 + 20 + 30 + asked - 1
        points = 0.5 + of_this + 2.0 * of_a_new_one  # half of what is under way, and two wait
        assert left_after(done, found) == pytest.approx(points * done / (done + 0.5))
    assert not any(each.at_most for each in found if 60.0 < each.seconds < 110.0)


@pytest.mark.parametrize("others", [57, 58])
def test_few_of_many_searches_tell_nothing(others: int) -> None:
    searches: list[Method] = [asking(1, first=i - 100.0) for i in range(3 + others)]
    known = ~np.isnan(left_after(3.0, shown(searches, at_once=1)))
    assert known == (others == 57)  # a twentieth
