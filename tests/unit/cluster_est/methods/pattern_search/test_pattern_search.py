from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from support.problems.constrained import CONSTRAINED, held
from support.problems.functions import PROBLEMS, FunctionExecutor, FunctionProblem, followed, named
from support.problems.unloaded import unloaded_problem

from cluster_est import Parameter
from cluster_est.errors import ProblemError
from cluster_est.methods import PatternSearch
from cluster_est.methods.method import Ending
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

EIGHT = FunctionProblem("eight", lambda x: x - np.arange(8.0), (5.0,) * 8, 0.0)


def poll_of(problem: FunctionProblem, **options: object) -> np.ndarray:
    """The steps of the first poll, in units of the start."""
    method = PatternSearch(search_step="none", **options)  # type: ignore[arg-type]
    start, poll, *_ = followed(problem, method).requests
    assert len(start.x) == 1
    return (poll.x - start.x) / start.x


class TestPoll:
    def test_both_ways_along_each_axis_in_one_request(self):
        steps = poll_of(EIGHT, initial_mesh=0.25)
        expected = 0.25 * np.concatenate([np.eye(8), -np.eye(8)])
        assert {tuple(s) for s in steps.round(12)} == {tuple(s) for s in expected}
        assert len(steps) == 16

    def test_a_simplex_has_one_direction_more_than_unknowns(self):
        steps = poll_of(EIGHT, basis="n+1", initial_mesh=0.25)
        assert len(steps) == 9
        np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.25)
        np.testing.assert_allclose(steps.sum(axis=0), 0.0, atol=1e-12)  # so they span positively

    def test_next_to_a_bound_it_goes_along_the_bound(self):
        cornered = replace(EIGHT, lower=(5.0,) * 8, upper=(np.inf,) * 8)
        steps = poll_of(cornered, initial_mesh=0.25)
        assert {tuple(s) for s in steps.round(12)} == {tuple(s) for s in 0.25 * np.eye(8)}

    def test_a_model_adds_few_points_to_the_same_request(self):
        polls = followed(EIGHT, PatternSearch()).requests[1:]
        assert max(len(poll.x) for poll in polls) <= 16 + 3
        assert {poll.purpose for poll in polls} == {"poll"}

    @pytest.mark.parametrize("points", [0, 5])
    def test_a_latin_hypercube_is_spread_over_every_axis(self, points):
        count = points or 8
        method = PatternSearch(search_step="latin_hypercube", search_points=points)
        start, poll = followed(EIGHT, method).requests[:2]
        assert len(poll.x) == 16 + count
        scattered = (poll.x[16:] - start.x) / (0.25 * start.x)  # meshes, from -4 to 4
        cells = np.floor((scattered + 4.0) / 8.0 * count)
        np.testing.assert_array_equal(np.sort(cells, axis=0).T, np.tile(np.arange(count), (8, 1)))


@pytest.mark.parametrize("problem", PROBLEMS[2:4] + PROBLEMS[8:9], ids=lambda p: p.name)
@pytest.mark.parametrize("basis", ["2n", "n+1"])
def test_no_point_is_asked_for_twice(problem, basis):
    points = followed(problem, PatternSearch(basis=basis)).points
    assert max(Counter(x.tobytes() for x in points).values()) == 1


@pytest.mark.parametrize(
    "options",
    [
        {"basis": "n+1"},
        {"axes": "random"},
        pytest.param({"search_step": "none"}, marks=pytest.mark.slow),
        {"search_step": "latin_hypercube"},
        {"axes": "coordinates", "expansion": 1.0, "contraction": 0.25},
    ],
    ids=str,
)
def test_every_choice_finds_the_minimum(options):
    for problem in (PROBLEMS[3], PROBLEMS[8]):
        solution = problem.solve(PatternSearch(max_iterations=5000, **options))
        assert solution.cost == pytest.approx(problem.minimum, rel=1e-5, abs=1e-5)


class TestConstraints:
    def test_constraints_on_parameters_hold_at_every_point(self):
        parameters = [Parameter("a", 1.0), Parameter("b", 3.0), Parameter("c", 0.5)]
        problem = unloaded_problem(parameters, 1, ["a <= b - 0.5", "a + b + c == 4.5"])
        seen = []

        def residuals(x):
            seen.append(x.copy())
            return x - np.array([3.0, 1.0, 2.0])

        with FunctionExecutor(residuals) as executor:
            request = SearchRequest("test", PatternSearch(), make_space(problem, (0,)))
            (solution,) = Runner(executor).run([request])
        points = np.array(seen)
        assert (points[:, 0] <= points[:, 1] - 0.5 + 1e-8).all()
        np.testing.assert_allclose(points.sum(axis=1), 4.5, atol=1e-8)
        # on the line a = b - 1/2, c = 5 - 2 b, (b - 3.5)^2 + (b - 1)^2 + (3 - 2 b)^2 is least
        np.testing.assert_allclose(solution.x, [1.25, 1.75, 1.5], atol=1e-4)

    def test_constraints_that_contradict_each_other(self):
        both = [lambda x: x[0] + 1.0, lambda x: 1.0 - x[0]]
        solution = held("neither", lambda x: x, (1.0, 2.0), 0.0, least=both).solve(PatternSearch())
        assert solution.ending is Ending.INFEASIBLE
        assert "is violated most, by" in solution.message
        assert solution.at.violation == pytest.approx(1.0, abs=1e-3)

    def test_without_residuals_any_point_that_satisfies_them_will_do(self):
        disc = held("disc", lambda x: np.zeros(0), (3.0, 4.0), 0.0, least=[lambda x: x @ x - 1.0])
        solution = disc.solve(PatternSearch())
        assert solution.ending is Ending.CONVERGED
        assert np.linalg.norm(solution.x) <= 1.0 + 1e-6


def test_units_of_the_cost_and_the_constraints_do_not_matter():
    problem = named("hs14", CONSTRAINED)
    scaled = replace(problem, residuals=lambda x: 2.0**20 * problem.residuals(x))
    one, other = (each.solve(PatternSearch()).x for each in (problem, scaled))
    np.testing.assert_allclose(one, other, atol=1e-7)


def test_the_seed_alone_decides():
    method = PatternSearch(axes="random", search_step="latin_hypercube")
    first, again, other = (PROBLEMS[3].solve(method, seed) for seed in (1, 1, 2))
    assert first.x.tobytes() == again.x.tobytes()
    assert first.x.tobytes() != other.x.tobytes()


def test_a_mesh_that_never_becomes_finer_is_refused():
    with pytest.raises(ProblemError, match="contraction"):
        PatternSearch(contraction=1.0).check(EIGHT.space())
