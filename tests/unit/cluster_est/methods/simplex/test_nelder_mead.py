"""That it finds the minima of known problems is said by the product of methods and problems."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from support.problems.constrained import TOTAL
from support.problems.functions import PROBLEMS, ROSENBROCK, FunctionProblem, followed, named
from support.problems.rough import ROUGH

from cluster_est.errors import ProblemError
from cluster_est.methods import NelderMead
from cluster_est.methods.method import Ending

TIGHT = NelderMead(bounds="enforce", xtol=1e-8, ftol=1e-12)


@pytest.mark.parametrize("problem", [p for p in PROBLEMS if p.lower is None], ids=lambda p: p.name)
def test_needs_hardly_more_evaluations_than_scipy_for_the_same(problem):
    def cost(x):
        return float(np.add.reduce(problem.residuals(x) ** 2))

    options = {"xatol": 1e-6, "fatol": 1e-8, "maxfev": 10000, "maxiter": 10000}
    theirs = minimize(cost, problem.start, method="Nelder-Mead", options=options)
    ours = followed(problem, NelderMead())
    assert len(ours.points) <= 1.5 * theirs.nfev
    assert ours.solution.cost <= theirs.fun * (1.0 + 1e-6) + 1e-8


@pytest.mark.parametrize("size", [6, 8])
def test_two_vertices_at_once_need_fewer_rounds(size):
    rows = np.cos(np.arange(size**2).reshape(size, size)) + 2.0 * np.eye(size)
    problem = FunctionProblem("bowl", lambda x: rows @ (x - 0.5), (1.0,) * size, 0.0)
    alone, together = (followed(problem, replace(NelderMead(), parallel=p)) for p in (1, 2))
    for found in (alone, together):
        assert found.solution.cost == pytest.approx(0.0, abs=1e-9)
    assert len(together.requests) < 0.8 * len(alone.requests)


@pytest.mark.parametrize("parallel", [1, 2])
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_speculation_changes_no_bit_and_saves_rounds(problem, parallel):
    plain = replace(TIGHT, parallel=parallel)
    first, second = (followed(problem, replace(plain, speculative=s)) for s in (False, True))
    assert first.solution.x.tobytes() == second.solution.x.tobytes()
    assert first.solution.iterations == second.solution.iterations
    assert len(second.requests) < 0.8 * len(first.requests)


def test_asks_the_start_then_the_rest_of_the_simplex_at_once():
    found = followed(PROBLEMS[2], NelderMead())
    assert found.purposes[:3] == ["start", "simplex", "trial"]
    assert [len(request.x) for request in found.requests[:2]] == [1, 4]
    assert found.purposes[-1] == "poll"


def test_a_simplex_that_collapsed_is_not_taken_for_a_minimum():
    """K. I. M. McKinnon, Convergence of the Nelder-Mead simplex method to a nonstationary point,
    SIAM J. Optim. 9 (1998) 148-158, doi:10.1137/S1052623496303482, in coordinates in which his
    simplex is the first one here."""
    root = np.sqrt(33.0)
    edges = np.array([[1.0, 1.0], [(1.0 + root) / 8.0, (1.0 - root) / 8.0]])

    def mckinnon(x):
        a, b = (x - 1.0) / 0.25 @ edges
        return np.array([(360.0 if a <= 0.0 else 6.0) * a**2 + b + b**2])

    problem = FunctionProblem("mckinnon", mckinnon, (1.0, 1.0), -0.25, cost=TOTAL)
    assert problem.solve(NelderMead(max_restarts=0)).cost == pytest.approx(0.0, abs=1e-3)
    assert problem.solve(NelderMead()).cost == pytest.approx(-0.25, abs=1e-7)


def test_says_when_all_restarts_lead_further_down():
    edges = named("edges", [problem for problem, _ in ROUGH])
    solution = edges.solve(NelderMead(coefficients="classical", max_restarts=1))
    assert solution.ending is Ending.STALLED
    assert "max_restarts" in solution.message


def test_failures_everywhere_else_leave_the_start():
    problem = FunctionProblem(
        "island", lambda x: np.where(np.all(x == 1.0), x, np.nan), (1.0, 1.0), 2.0
    )
    assert problem.solve(NelderMead()).cost == 2.0


def test_a_flat_cost_ends():
    solution = FunctionProblem("flat", lambda x: 0.0 * x, (1.0, 1.0), 0.0).solve(NelderMead())
    assert solution.ending is Ending.CONVERGED


class TestBounds:
    BOUNDED = replace(ROSENBROCK, lower=(-2.0, -np.inf), upper=(0.5, np.inf), minimum=0.25)

    def test_are_refused_with_a_way_out(self):
        said = r'(?s)parameters.x0.bounds.*\[-2, 0.5\].*method.options.bounds = "enforce"'
        with pytest.raises(ProblemError, match=said):
            NelderMead().check(self.BOUNDED.space())
        NelderMead(bounds="enforce").check(self.BOUNDED.space())
        NelderMead().check(ROSENBROCK.space())

    def test_a_start_in_a_corner_is_left(self):
        corner = replace(ROSENBROCK, start=(-2.0, 3.0), lower=(-2.0, -2.0), upper=(2.0, 3.0))
        assert corner.solve(TIGHT).cost == pytest.approx(0.0, abs=1e-12)


class TestOneUnknown:
    @pytest.mark.parametrize(
        ("residual", "minimum", "lower", "upper", "most"),
        [
            pytest.param(lambda x: x - 3.3, 0.0, None, None, 15, id="free"),
            pytest.param(lambda x: x - 3.3, 0.0, -5.0, 100.0, 12, id="both bounds"),
            pytest.param(lambda x: x - 3.3, 1.69, -5.0, 2.0, 45, id="at a bound"),
            pytest.param(lambda x: x - 3.3, 0.0, -5.0, np.inf, 15, id="one bound"),
            pytest.param(lambda x: x + 13.3, 68.89, -5.0, np.inf, 45, id="at the only bound"),
            pytest.param(lambda x: np.cosh(x - 2.0), 1.0, None, None, 25, id="not parabolic"),
            pytest.param(
                lambda x: np.where(x < 3.0, x - 3.3, np.nan), 0.09, -5.0, 20.0, 80, id="fails > 3"
            ),
        ],
    )
    def test_is_found_quickly(self, residual, minimum, lower, upper, most):
        bounds = (None, None) if lower is None else ((lower,), (upper,))
        problem = FunctionProblem("one", residual, (1.0,), minimum, *bounds)
        NelderMead().check(problem.space())
        found = followed(problem, NelderMead())
        assert found.solution.cost == pytest.approx(minimum, rel=1e-6, abs=1e-12)
        assert found.solution.ending is Ending.CONVERGED
        assert len(found.points) <= most
        assert found.purposes[0] == "start"
        if lower is not None:
            assert (found.points >= lower).all()
            assert (found.points <= upper).all()

    def test_never_ends_above_the_start(self):
        def waves(x):
            return 2.0 + np.sin(3.0 * x) + 0.1 * (x - 8.0) ** 2

        solution = FunctionProblem("waves", waves, (7.9,), 0.0, (-30.0,), (30.0,)).solve(
            NelderMead()
        )
        assert solution.x[0] == pytest.approx(7.857, abs=1e-3)

    def test_stops_at_the_limit(self):
        problem = FunctionProblem("downhill", lambda x: np.exp(-x / 2.0), (1.0,), 0.0)
        assert problem.solve(NelderMead(max_iterations=5)).ending is Ending.MAX_ITERATIONS

    def test_a_failed_start_says_so(self):
        solution = FunctionProblem("broken", lambda x: x * np.nan, (1.0,), 0.0).solve(NelderMead())
        assert solution.ending is Ending.START_FAILED
        assert "not finite" in solution.message
