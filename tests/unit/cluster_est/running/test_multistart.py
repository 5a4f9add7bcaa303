"""Multi-start: where searches begin, when they are enough, and which minima are one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fclusterdata
from support.problems.functions import FunctionExecutor, FunctionProblem
from support.scripted import Scripted, ask
from support.shuffling_executor import ShufflingExecutor

from cluster_est import Budget, LeastSquares, Multistart
from cluster_est.errors import ProblemError
from cluster_est.methods import Method
from cluster_est.methods.method import Ending, Search, Solution
from cluster_est.problem.formulas import parse_constraint
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.multistart import (
    MultistartResult,
    cluster,
    make_starts,
    sample,
    search_from_starts,
)
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

MINIMA = np.array(
    [
        [3.0, 2.0],
        [-2.805118086952745, 3.131312518250573],
        [-3.779310253377747, -3.283185991286170],
        [3.584428340330492, -1.848126526964404],
    ]
)
"""Of the next function; all are zeros. D. M. Himmelblau, Applied Nonlinear Programming (1972)."""


def himmelblau(x):
    return np.array([x[0] ** 2 + x[1] - 11.0, x[0] + x[1] ** 2 - 7.0])


def three_pairs(x):
    """64 minima in six unknowns, of different costs because of the last two residuals."""
    pairs = [himmelblau(x[i : i + 2]) for i in (0, 2, 4)]
    return np.concatenate([*pairs, [0.1 * (x[0] + x[2] - 1.0), 0.2 * (x[3] - x[5])]])


def half_dead(x):
    """Cannot be simulated on the right."""
    return np.array([np.nan, np.nan]) if x[0] > 0.0 else himmelblau(x)


def boxed(function, size: int = 2) -> FunctionProblem:
    return FunctionProblem("", function, (0.0,) * size, 0.0, (-5.0,) * size, (5.0,) * size)


HIMMELBLAU = boxed(himmelblau)
HALF_DEAD = boxed(half_dead)
PAIRS = boxed(three_pairs, 6)


def space_of(problem: FunctionProblem, *constraints: str, scale: str = "linear") -> SearchSpace:
    made = problem.problem()
    names = tuple(p.name for p in made.parameters)
    demands = [c for text in constraints for c in parse_constraint(text, names, "constraints")]
    scaled = tuple(replace(p, scale=scale) for p in made.parameters)
    return make_space(replace(made, parameters=scaled, constraints=tuple(demands)), (0,))


def runner_of(problem: FunctionProblem, **more) -> Runner:
    return Runner(FunctionExecutor(problem.residuals, problem.constraints), **more)


def shuffled(problem: FunctionProblem, seed: int, workers: int, **more) -> Runner:
    return Runner(ShufflingExecutor(problem.answer, seed, workers), **more)


def search(
    problem: FunctionProblem,
    multistart: Multistart,
    method: Method | None = None,
    runner: Runner | None = None,
) -> MultistartResult:
    runner = runner or runner_of(problem)
    return search_from_starts(runner, space_of(problem), method or LeastSquares(), multistart, 0)


def bits(found: MultistartResult) -> tuple[bytes, list[tuple[bytes, float, str]], object, object]:
    ends = [(s.x.tobytes(), s.cost, s.ending.name) for s in found.solutions]
    return found.starts.tobytes(), ends, found.minima, found.minimum


# --- where searches begin


def strata(points, cells: Sequence[int]) -> set[tuple[int, ...]]:
    """The cells of a grid over [-5, 5]^2 that points lie in."""
    return {tuple(row) for row in np.floor((points + 5.0) / 10.0 * cells).astype(int).tolist()}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sobol_points_are_balanced(seed):
    """16 points of a Sobol sequence in two unknowns: one in each box of any shape of area 1/16."""
    points = sample(space_of(HIMMELBLAU), 16, Multistart(seed=seed))
    for cells in ((16, 1), (8, 2), (4, 4), (2, 8), (1, 16)):
        assert len(strata(points, cells)) == 16


def test_more_sobol_points_begin_with_the_same():
    few, many = (sample(space_of(HIMMELBLAU), n, Multistart()) for n in (5, 13))
    np.testing.assert_array_equal(few, many[:5])


@pytest.mark.parametrize("count", [1, 7, 16])
def test_a_latin_hypercube_has_one_point_in_each_slice(count):
    points = sample(space_of(HIMMELBLAU), count, Multistart(sampler="latin_hypercube"))
    for column in points.T:
        slices = np.floor((column + 5.0) / 10.0 * count).astype(int)
        assert sorted(slices.tolist()) == list(range(count))


@given(
    st.sampled_from(["sobol", "latin_hypercube", "uniform"]),
    st.integers(1, 40),
    st.integers(0, 2**32 - 1),
    st.floats(-1e6, 1e6),
    st.floats(1e-6, 1e6),
)
def test_points_lie_within_the_bounds_and_follow_from_the_seed(kind, count, seed, low, width):
    high = low + max(width, 1e-6 * abs(low))
    problem = FunctionProblem("", himmelblau, (low, low), 0.0, (low,) * 2, (high,) * 2)
    space, multistart = space_of(problem), Multistart(sampler=kind, seed=seed)
    points = sample(space, count, multistart)
    assert points.shape == (count, 2)
    assert ((points >= space.lower) & (points <= space.upper)).all()
    np.testing.assert_array_equal(points, sample(space, count, multistart))
    assert (points != sample(space, count, multistart.changed(seed=seed ^ 1))).any()


def test_on_a_log_scale_each_decade_gets_as_many():
    problem = FunctionProblem("", himmelblau, (1.0, 1.0), 0.0, (1e-4, 1e-4), (1e4, 1e4))
    space = space_of(problem, scale="log")
    decades = np.floor(sample(space, 64, Multistart()) / np.log(10.0)).astype(int)
    for column in decades.T:
        assert np.unique(column, return_counts=True)[1].tolist() == [8] * 8


def test_samples_satisfy_constraints_on_parameters():
    space = space_of(HIMMELBLAU, "x0 <= x1", "x0^2 + x1^2 <= 16")
    points = sample(space, 100, Multistart())
    assert len(points) == 100
    assert (points[:, 0] <= points[:, 1]).all()
    assert ((points**2).sum(axis=1) <= 16.0).all()


def test_where_no_sample_satisfies_them_those_that_nearly_do_are_taken():
    points = sample(space_of(HIMMELBLAU, "x0 + x1 = 1"), 10, Multistart())
    assert np.abs(points.sum(axis=1) - 1.0).max() < 0.2  # 500 drawn, sums from -10 to 10


def test_bounds_must_be_finite_to_sample_them():
    problem = replace(HIMMELBLAU, upper=(5.0, np.inf))
    with pytest.raises(ProblemError, match=r"parameters.x1.bounds: must be finite.* \[-5, inf\]"):
        search(problem, Multistart(2))
    positive = FunctionProblem("", himmelblau, (1.0, 1.0), 0.0, (0.0, 0.0), (5.0, 5.0))
    with pytest.raises(ProblemError, match=r"must be finite.*positive"):
        sample(space_of(positive, scale="log"), 1, Multistart())


def test_points_of_the_users_need_no_bounds():
    problem = FunctionProblem("", himmelblau, (0.0, 0.0), 0.0)
    found = search(problem, Multistart(points=({"x0": 3.0, "x1": 1.0}, {"x0": -3.0})))
    np.testing.assert_array_equal(found.starts, [[0.0, 0.0], [3.0, 1.0], [-3.0, 0.0]])


def test_starts_are_the_own_one_then_the_given_ones_then_samples():
    multistart = Multistart(5, points=({"x1": 4.0}, {"x0": 1.0, "x1": -2.0}))
    starts = make_starts(runner_of(HIMMELBLAU), space_of(HIMMELBLAU), multistart)
    np.testing.assert_array_equal(starts[:3], [[0.0, 0.0], [0.0, 4.0], [1.0, -2.0]])
    np.testing.assert_array_equal(starts[3:], sample(space_of(HIMMELBLAU), 2, Multistart()))
    assert Multistart(2, points=multistart.points).searches == 3


def test_given_points_are_physical():
    problem = FunctionProblem("", himmelblau, (1.0, 1.0), 0.0, (1e-3, 1e-3), (1e3, 1e3))
    space = space_of(problem, scale="log")
    starts = make_starts(runner_of(problem), space, Multistart(points=({"x0": 100.0},)))
    assert space.estimates(starts[1]) == pytest.approx({"x0": 100.0, "x1": 1.0}, rel=1e-12)


@pytest.mark.parametrize(
    ("point", "phrase"),
    [
        ({"x2": 1.0}, "multistart.points: there is no unknown 'x2'; did you mean"),
        (
            {"x1": 6.0},
            r"multistart.points: x1 must lie within its bounds \[-5, 5\], but is 6; change the "
            "point",
        ),
    ],
)
def test_a_given_point_that_is_none_is_refused(point, phrase):
    with pytest.raises(ProblemError, match=phrase):
        search(HIMMELBLAU, Multistart(points=(point,)))


def test_screening_takes_the_best_of_many():
    starts = search(HIMMELBLAU, Multistart(9, screen=8)).starts
    many = sample(space_of(HIMMELBLAU), 64, Multistart())
    costs = np.array([(himmelblau(x) ** 2).sum() for x in many])
    np.testing.assert_array_equal(starts[1:], many[np.argsort(costs)[:8]])


def test_screening_passes_over_what_fails():
    found = search(HALF_DEAD, Multistart(9, screen=4))
    assert (found.starts[1:, 0] <= 0.0).all()
    assert not any(end.ending is Ending.START_FAILED for end in found.solutions)
    assert (
        -1 not in found.minimum[1:]
    )  # the first begins at the edge of what fails, and stays there


def test_screening_prefers_what_satisfies_the_constraints():
    problem = replace(HIMMELBLAU, constraints=lambda x: x[:1] + 2.0, equality=(False,))
    starts = make_starts(runner_of(problem), space_of(problem), Multistart(9, screen=8))
    assert (starts[1:, 0] <= -2.0).all()


def test_screening_where_nothing_can_be_simulated():
    dead = boxed(lambda x: np.array([np.nan, np.nan]))
    found = search(dead, Multistart(3, screen=2))
    assert found.best.ending is Ending.START_FAILED
    assert found.minima == ()


# --- which minima are one


def solution(x, cost: float, ending: Ending = Ending.CONVERGED) -> Solution:
    return Solution(np.array(x, float), cost, ending)


def test_minima_are_numbered_from_the_best():
    solutions = [
        solution([3.0, 2.0], 7.0),
        solution([1.0, 1.0], 2.0),
        solution([3.001, 2.001], 6.9),
        solution([0.0, 0.0], 0.5, Ending.MAX_ITERATIONS),
        solution([-1.0, 1.0], 2.5, Ending.PERFECT),
        solution([2.0, 2.0], np.nan, Ending.START_FAILED),
        solution([1.0, 1.0], 2.0),
    ]
    minima, number = cluster(space_of(HIMMELBLAU), solutions, 1e-3)
    assert minima == (1, 4, 2)
    assert number == (2, 0, 2, -1, 1, -1, 0)


@given(st.permutations(range(6)), st.floats(1e-6, 1e6))
def test_neither_order_nor_units_decide_which_minima_are_one(order, unit):
    places = np.array([[0.0, 0.0], [0.009, 0.0], [4.0, 4.0], [4.0, 4.009], [-4.0, 2.0], [4.0, 3.0]])
    problem = FunctionProblem("", himmelblau, (0.0,) * 2, 0.0, (-5 * unit,) * 2, (5 * unit,) * 2)
    solutions = [solution(unit * places[i], 1.0 + i) for i in order]
    minima, number = cluster(space_of(problem), solutions, 1e-3)
    assert [order[i] for i in minima] == [0, 2, 4, 5]
    assert [number[order.index(i)] for i in range(6)] == [0, 0, 1, 1, 2, 3]


def test_a_point_that_violates_constraints_is_no_better_minimum_for_its_cost():
    problem = replace(HIMMELBLAU, constraints=lambda x: x[:1] - 1.0, equality=(False,))
    space, places = space_of(problem), np.array([[3.0, 2.0], [0.0, 0.0]])
    ends = runner_of(problem).run([STAY.on(space.starting_at(x)) for x in places])
    assert [end.cost for end in ends] == [0.0, 170.0]
    minima, _ = cluster(space, ends, 1e-3)
    assert minima == (1, 0)
    assert MultistartResult(np.zeros((2, 2)), tuple(ends), minima, (1, 0)).best is ends[1]


def test_without_any_minimum_the_best_point_is_taken():
    found = search(HIMMELBLAU, Multistart(6), LeastSquares(max_iterations=1))
    assert found.minima == ()
    assert set(found.minimum) == {-1}
    assert found.best.cost == min(s.cost for s in found.solutions)


# --- when starts are enough


def stay(space: SearchSpace) -> Search:
    """Take the start for a minimum; some take longer than others to do so."""
    start = space.start[0]
    (found,) = yield ask(space, [start], "start")
    for i in range(int(10 * abs(start)) % 7):
        yield ask(space, [start * (0.9 - 0.01 * i)], "trial")
    if not found.ok:
        return Solution(space.start, np.nan, Ending.START_FAILED, found.reason, at=found)
    return Solution(space.start, found.cost, Ending.CONVERGED, at=found)


STAY = Scripted(stay)


def stays(x0: Sequence[float]) -> tuple[dict[str, float], ...]:
    return tuple({"x0": value} for value in x0)


@pytest.mark.parametrize(
    ("patience", "given", "searches"),
    [
        (0, [1, 0, 0, 0, 0, 2], 7),  # never
        (3, [1, 0, 1, 0, 2, 2], 5),  # the own start is at 0, and 2 is not seen any more
        (4, [1, 0, 1, 0, 2, 2], 7),
        (3, [1, 0, 1, 2, 2, 2, 2, 3], 8),
        (1, [1, 2, 3, 3, 4], 5),
        (1, [0, 1], 2),
        (9, [0, 0], 3),
    ],
)
def test_patience_counts_starts_in_a_row_without_a_new_minimum(patience, given, searches):
    multistart = Multistart(points=stays(given), patience=patience)
    found = search(HIMMELBLAU, multistart, STAY)
    assert len(found.solutions) == len(found.starts) == len(found.minimum) == searches
    assert len(found.minima) == len({0, *given[: searches - 1]})


def test_failed_starts_bring_nothing_new_but_end_nothing_before_the_first_minimum():
    dead_at_first = boxed(lambda x: himmelblau(x) if x[0] < 0.0 else np.full(2, np.nan))
    multistart = Multistart(points=stays([1, 2, 3, -1, 1, 2, 3, -2]), patience=2)
    found = search(dead_at_first, multistart, STAY)
    assert found.minimum == (-1, -1, -1, -1, 0, -1, -1)


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.integers(1, 9),
    st.lists(st.sampled_from([0.0, 0.3, 0.5, 1.1, 1.7, 2.9]), min_size=1, max_size=9),
)
@pytest.mark.slow
def test_which_starts_are_enough_does_not_depend_on_which_is_faster(seed, workers, at_once, given):
    multistart = Multistart(points=stays(given), patience=2)
    expected = bits(search(HIMMELBLAU, multistart.changed(at_once=1), STAY))
    runner = shuffled(HIMMELBLAU, seed, workers)
    found = search(HIMMELBLAU, multistart.changed(at_once=at_once), STAY, runner)
    assert bits(found) == expected


# --- what is found


@pytest.mark.parametrize("sampler", ["sobol", "latin_hypercube", "uniform"])
def test_all_minima_are_found(sampler):
    found = search(HIMMELBLAU, Multistart(24, sampler=sampler))
    places = np.array([found.solutions[i].x for i in found.minima])
    assert len(places) == 4
    gaps = np.abs(places[:, None] - MINIMA).max(axis=2)
    assert gaps.min(axis=0).max() < 1e-6
    assert found.best is found.solutions[found.minima[0]]


def separate(problem: FunctionProblem, starts: Sequence[np.ndarray]) -> list[Solution]:
    """A fit of its own from each start."""
    space = space_of(problem)
    requests = [SearchRequest("alone", LeastSquares(), space.starting_at(x), 0) for x in starts]
    return [runner_of(problem).run([request])[0] for request in requests]


def test_every_minimum_that_separate_fits_find():
    """32 starts in six unknowns, as many as the issue asks for."""
    found = search(PAIRS, Multistart(32))
    alone = separate(PAIRS, found.starts)
    for one, other in zip(found.solutions, alone, strict=True):
        assert one.x.tobytes() == other.x.tobytes()
        assert (one.cost, one.ending) == (other.cost, other.ending)
    ends = [end.x for end in alone if end.ending.success]
    assert len(found.minima) == len(set(fclusterdata(ends, 1e-2, "distance"))) > 10
    costs = [found.solutions[i].cost for i in found.minima]
    assert costs == sorted(costs)
    assert found.best.cost == min(s.cost for s in alone if s.ending.success)


def test_starts_that_fail_spoil_no_other():
    found = search(HALF_DEAD, Multistart(16))
    assert 0 < found.minimum.count(-1) < 16
    for start, end, number in zip(found.starts, found.solutions, found.minimum, strict=True):
        failed = bool(start[0] > 0.0)
        assert (end.ending is Ending.START_FAILED) is failed
        assert end.ending.success is (number != -1)
        assert ("not finite" in end.message) is failed
    assert found.best.cost < 1e-12


SHORT = 60
"""Points: enough for three searches of two unknowns, as `plan_for_budget` counts them."""


def begun(problem: FunctionProblem, evaluations: int, n: int):
    """The result with a budget, and the names of the searches in the order of their simulations."""
    seen: list[str] = []
    budget = Budget(evaluations=evaluations)
    runner = runner_of(problem, budget=budget, record=lambda origin, _: seen.append(origin.search))
    return search(problem, Multistart(n), runner=runner), list(dict.fromkeys(seen)), runner


def test_a_budget_too_short_for_all_starts_goes_to_the_best_ones():
    found, searches, runner = begun(HIMMELBLAU, SHORT, 20)
    assert searches[0] == "starts"
    costs = [float(np.sum(himmelblau(x) ** 2)) for x in found.starts]
    assert costs == sorted(costs)
    assert len(found.solutions) == len(found.starts) == 20
    assert found.best.cost < 1e-6
    assert {s.ending for s in found.solutions[-10:]} == {Ending.BUDGET}
    assert runner.evaluations <= SHORT + 8


@pytest.mark.parametrize("evaluations", [1, 2, 5, 12, 30])
def test_a_budget_for_less_than_a_search_gives_the_best_of_the_starts_that_are_tried(evaluations):
    found, _, _ = begun(PAIRS, evaluations, 64)
    tried = [float(np.sum(three_pairs(x) ** 2)) for x in found.starts]
    assert np.isfinite(found.best.cost)
    assert found.best.cost <= min(tried[: max(1, evaluations // 4)])


def test_a_budget_that_is_long_enough_changes_nothing():
    found, searches, _ = begun(HIMMELBLAU, 10_000, 8)
    assert "starts" not in searches
    assert bits(found) == bits(search(HIMMELBLAU, Multistart(8)))


def test_one_start_is_not_tried_before_its_search():
    _, searches, _ = begun(HIMMELBLAU, 5, 1)
    assert searches == ["train"]


def test_starts_that_fail_come_last():
    found, _, _ = begun(HALF_DEAD, SHORT, 16)
    failed = [bool(x[0] > 0.0) for x in found.starts]
    assert failed == sorted(failed)
    assert found.best.cost < 1e-6


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
@settings(max_examples=15)
def test_a_short_budget_ends_at_the_same_bits_whatever_order_answers_come_in(seed, workers):
    runner = shuffled(HIMMELBLAU, seed, workers, budget=Budget(evaluations=SHORT))
    found = search(HIMMELBLAU, Multistart(12), runner=runner)
    assert bits(found) == bits(begun(HIMMELBLAU, SHORT, 12)[0])
