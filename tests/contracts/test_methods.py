"""What every method must do, as a product of all methods and classical problems.

A new method joins by an entry in METHODS.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from function_problems import PROBLEMS, FunctionProblem, rosenbrock

from cluster_est import LeastSquares, ScipyLeastSquares
from cluster_est.methods import METHODS as REGISTERED
from cluster_est.methods.base import Ending, Points, Solution
from cluster_est.space import make_space

METHODS = [
    LeastSquares(max_iterations=300),
    LeastSquares(trials=1, max_iterations=300),
    ScipyLeastSquares(),
    ScipyLeastSquares(algorithm="dogbox"),
]


def test_every_registered_method_is_tested():
    assert {type(m) for m in METHODS} == set(REGISTERED.values())


@pytest.mark.parametrize("method", METHODS, ids=repr)
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
class TestMethod:
    def test_finds_the_minimum(self, method, problem):
        if "dogbox" in repr(method) and "bounded" in problem.name:
            pytest.skip("dogbox stops early where a bound is active on the way, as documented")
        solution = problem.solve(method)
        assert solution.cost == pytest.approx(problem.minimum, rel=1e-7, abs=1e-12)

    def test_stays_within_the_bounds(self, method, problem):
        seen = []

        def watched(x):
            seen.append(x.copy())
            return problem.residuals(x)

        replace(problem, residuals=watched).solve(method)
        points = np.array(seen)
        assert (points >= np.array(problem.lower or -np.inf)).all()
        assert (points <= np.array(problem.upper or np.inf)).all()

    def test_same_seed_same_bits(self, method, problem):
        first, second = problem.solve(method), problem.solve(method)
        assert first.x.tobytes() == second.x.tobytes()
        assert first.iterations == second.iterations


@pytest.mark.parametrize("method", METHODS, ids=repr)
class TestSearch:
    def test_can_be_closed_at_any_time(self, method):
        problem = PROBLEMS[0].problem()
        search = method.search(make_space(problem, (0,)), np.random.default_rng(0))
        assert isinstance(next(search), Points)
        search.close()

    def test_a_failed_start_is_a_solution_that_says_so(self, method):
        broken = FunctionProblem("broken", lambda x: np.array([np.nan, 1.0]), (1.0, 1.0), 0.0)
        solution = broken.solve(method)
        assert isinstance(solution, Solution)
        assert solution.ending is Ending.START_FAILED
        assert "not finite" in solution.message

    def test_failed_trials_do_not_end_the_search(self, method):
        def walled(x):
            return rosenbrock(x) if x[1] > -2.0 and x[0] < 1.05 else np.full(2, np.nan)

        solution = FunctionProblem("walled", walled, (-1.2, 1.0), 0.0).solve(method)
        assert solution.cost == pytest.approx(0.0, abs=1e-12)

    def test_units_of_the_unknowns_do_not_matter(self, method):
        scale = np.array([1e6, 1e-4])
        scaled = FunctionProblem(
            "scaled", lambda x: rosenbrock(x / scale), (-1.2e6, 1e-4), 0.0
        ).solve(method)
        plain = PROBLEMS[0].solve(method)
        np.testing.assert_allclose(scaled.x / scale, plain.x, rtol=1e-6)

    def test_scaling_the_residuals_does_not_matter(self, method):
        scaled = FunctionProblem("scaled", lambda x: 2.0**20 * rosenbrock(x), (-1.2, 1.0), 0.0)
        np.testing.assert_allclose(scaled.solve(method).x, PROBLEMS[0].solve(method).x, rtol=1e-9)
