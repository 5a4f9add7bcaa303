"""Simplex search: classical minima, SciPy's as a yardstick, batches, bounds, one unknown."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import minimize
from support.problems.functions import PROBLEMS, FunctionExecutor, FunctionProblem, rosenbrock
from support.problems.rough import ROUGH

from cluster_est.costs.total import TotalCost
from cluster_est.errors import ProblemError
from cluster_est.methods.base import Ending, Solution
from cluster_est.methods.simplex.nelder_mead import NelderMead
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.evaluation import assemble_evaluation

TIGHT = NelderMead(bounds="enforce", xtol=1e-8, ftol=1e-12)
HALVES = replace(TIGHT, parallel=2)
METHODS = [
    TIGHT,
    HALVES,
    replace(TIGHT, speculative=True),
    replace(TIGHT, coefficients="classical"),
]
SMOOTH = [p for p in PROBLEMS if p.lower is None]
ROSENBROCK = PROBLEMS[0]


@dataclass
class Asked:
    """A solution and what it was found with."""

    solution: Solution
    points: list[np.ndarray]
    purposes: list[str]

    @property
    def evaluations(self) -> int:
        return sum(map(len, self.points))


def followed(problem: FunctionProblem, method: NelderMead) -> Asked:
    """Search without a runner, request by request."""
    space = make_space(problem.problem(), (0,))
    executor = FunctionExecutor(problem.residuals)
    search, answer = method.search(space, np.random.default_rng(0)), None
    points, purposes = [], []
    while True:
        try:
            request = search.send(answer)
        except StopIteration as end:
            return Asked(end.value, points, purposes)
        points.append(request.x.copy())
        purposes.append(request.purpose)
        executor.submit([_Task(i, x) for i, x in enumerate(request.x)])
        pairs = zip(request.x, executor.completed(), strict=True)
        answer = [
            assemble_evaluation(space, x, (outcome,), i) for i, (x, outcome) in enumerate(pairs)
        ]


@dataclass
class _Task:
    id: int
    values: np.ndarray
    want: str = "residuals"


@pytest.mark.parametrize("method", METHODS, ids=repr)
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_finds_classical_minima(method, problem):
    solution = problem.solve(method)
    assert solution.ending is Ending.CONVERGED
    assert solution.cost == pytest.approx(problem.minimum, rel=1e-7, abs=1e-12)


@pytest.mark.parametrize("problem", SMOOTH, ids=lambda p: p.name)
def test_needs_hardly_more_evaluations_than_scipy_for_the_same(problem):
    def cost(x):
        return float(np.add.reduce(problem.residuals(x) ** 2))

    options = {"xatol": 1e-6, "fatol": 1e-8, "maxfev": 10000, "maxiter": 10000}
    theirs = minimize(cost, problem.start, method="Nelder-Mead", options=options)
    ours = followed(problem, NelderMead())
    assert ours.evaluations <= 1.5 * theirs.nfev
    assert ours.solution.cost <= theirs.fun * (1.0 + 1e-6) + 1e-8


@pytest.mark.parametrize(("problem", "above"), ROUGH, ids=lambda p: getattr(p, "name", ""))
def test_copes_with_jumps_edges_and_noise(problem, above):
    assert problem.solve(NelderMead()).cost <= problem.minimum + above


@pytest.mark.parametrize("size", [6, 8])
def test_two_vertices_at_once_need_fewer_rounds(size):
    rows = np.cos(np.arange(size**2).reshape(size, size)) + 2.0 * np.eye(size)
    problem = FunctionProblem("bowl", lambda x: rows @ (x - 0.5), (1.0,) * size, 0.0)
    alone, together = (followed(problem, replace(NelderMead(), parallel=p)) for p in (1, 2))
    for asked in (alone, together):
        assert asked.solution.cost == pytest.approx(0.0, abs=1e-9)
    assert len(together.points) < 0.8 * len(alone.points)


@pytest.mark.parametrize("parallel", [1, 2])
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_speculation_changes_no_bit_and_saves_rounds(problem, parallel):
    plain = replace(TIGHT, parallel=parallel)
    first, second = (followed(problem, replace(plain, speculative=s)) for s in (False, True))
    assert first.solution.x.tobytes() == second.solution.x.tobytes()
    assert first.solution.iterations == second.solution.iterations
    assert len(second.points) < 0.8 * len(first.points)


def test_same_seed_same_bits():
    first, second = (ROSENBROCK.solve(HALVES) for _ in range(2))
    assert first.x.tobytes() == second.x.tobytes()


def test_asks_the_start_then_the_rest_of_the_simplex_at_once():
    asked = followed(PROBLEMS[2], NelderMead())
    assert asked.purposes[:3] == ["start", "simplex", "trial"]
    assert [len(p) for p in asked.points[:2]] == [1, 4]
    assert asked.purposes[-1] == "poll"


def test_a_simplex_that_collapsed_is_not_taken_for_a_minimum():
    """K. I. M. McKinnon, Convergence of the Nelder-Mead simplex method to a nonstationary point,
    SIAM J. Optim. 9 (1998) 148-158, doi:10.1137/S1052623496303482, in coordinates in which his
    simplex is the first one here."""
    root = np.sqrt(33.0)
    edges = np.array([[1.0, 1.0], [(1.0 + root) / 8.0, (1.0 - root) / 8.0]])

    def mckinnon(x):
        a, b = (x - 1.0) / 0.25 @ edges
        return np.array([(360.0 if a <= 0.0 else 6.0) * a**2 + b + b**2])

    problem = FunctionProblem("mckinnon", mckinnon, (1.0, 1.0), -0.25, cost=TotalCost())
    assert problem.solve(NelderMead(max_restarts=0)).cost == pytest.approx(0.0, abs=1e-3)
    assert problem.solve(NelderMead()).cost == pytest.approx(-0.25, abs=1e-7)


def test_says_when_all_restarts_lead_further_down():
    edges = next(p for p, _ in ROUGH if p.name == "edges")
    few = NelderMead(coefficients="classical", max_restarts=1)
    solution = edges.solve(few)
    assert solution.ending is Ending.STALLED
    assert "max_restarts" in solution.message


class TestFailures:
    def test_of_the_start_is_a_solution_that_says_so(self):
        for start in ((1.0,), (1.0, 1.0)):
            broken = FunctionProblem("broken", lambda x: np.array([np.nan, 1.0]), start, 0.0)
            solution = broken.solve(NelderMead())
            assert solution.ending is Ending.START_FAILED
            assert "not finite" in solution.message

    @pytest.mark.parametrize("method", METHODS, ids=repr)
    def test_of_trials_count_as_worst(self, method):
        def walled(x):
            return rosenbrock(x) if x[1] > -2.0 and x[0] < 1.05 else np.full(2, np.nan)

        solution = FunctionProblem("walled", walled, (-1.2, 1.0), 0.0).solve(method)
        assert solution.cost == pytest.approx(0.0, abs=1e-12)

    def test_everywhere_else_leave_the_start(self):
        def island(x):
            return np.where(np.all(x == 1.0), x, np.nan)

        solution = FunctionProblem("island", island, (1.0, 1.0), 2.0).solve(NelderMead())
        assert solution.cost == 2.0

    def test_a_flat_cost_ends(self):
        solution = FunctionProblem("flat", lambda x: 0.0 * x, (1.0, 1.0), 0.0).solve(NelderMead())
        assert solution.ending is Ending.CONVERGED


class TestScale:
    def test_of_the_unknowns_does_not_matter(self):
        scale = np.array([1e6, 1e-4])
        start = tuple(scale * (-1.2, 1.0))
        scaled = FunctionProblem("scaled", lambda x: rosenbrock(x / scale), start, 0.0)
        np.testing.assert_allclose(
            scaled.solve(TIGHT).x / scale, ROSENBROCK.solve(TIGHT).x, rtol=1e-6
        )

    def test_of_the_residuals_does_not_matter(self):
        scaled = FunctionProblem("scaled", lambda x: 2.0**20 * rosenbrock(x), (-1.2, 1.0), 0.0)
        assert scaled.solve(TIGHT).x.tobytes() == ROSENBROCK.solve(TIGHT).x.tobytes()


class TestBounds:
    BOUNDED = replace(ROSENBROCK, lower=(-2.0, -np.inf), upper=(0.5, np.inf), minimum=0.25)

    def test_are_refused_with_a_way_out(self):
        space = make_space(self.BOUNDED.problem(), (0,))
        with pytest.raises(ProblemError) as error:
            NelderMead().check(space)
        assert "parameters.x0.bounds" in str(error.value)
        assert "[-2, 0.5]" in str(error.value)
        assert 'method.options.bounds = "enforce"' in str(error.value)
        NelderMead(bounds="enforce").check(space)
        NelderMead().check(make_space(ROSENBROCK.problem(), (0,)))

    @pytest.mark.parametrize("method", METHODS, ids=repr)
    def test_are_enforced_when_asked(self, method):
        asked = followed(self.BOUNDED, method)
        points = np.concatenate(asked.points)
        assert (points[:, 0] >= -2.0).all()
        assert (points[:, 0] <= 0.5).all()
        np.testing.assert_allclose(asked.solution.x, [0.5, 0.25], atol=1e-6)

    def test_a_start_in_a_corner_is_left(self):
        corner = replace(ROSENBROCK, start=(-2.0, 3.0), lower=(-2.0, -2.0), upper=(2.0, 3.0))
        assert corner.solve(TIGHT).cost == pytest.approx(0.0, abs=1e-12)


ONE = [
    ("free", lambda x: x - 3.3, 0.0, None, None, 15),
    ("both bounds", lambda x: x - 3.3, 0.0, -5.0, 100.0, 12),
    ("at a bound", lambda x: x - 3.3, 1.69, -5.0, 2.0, 45),
    ("one bound", lambda x: x - 3.3, 0.0, -5.0, np.inf, 15),
    ("at the only bound", lambda x: x + 13.3, 68.89, -5.0, np.inf, 45),
    ("not parabolic", lambda x: np.cosh(x - 2.0), 1.0, None, None, 25),
    ("fails beyond 3", lambda x: np.where(x < 3.0, x - 3.3, np.nan), 0.09, -5.0, 20.0, 80),
]


class TestOneUnknown:
    @pytest.mark.parametrize(
        ("residual", "minimum", "lower", "upper", "most"),
        [p[1:] for p in ONE],
        ids=[p[0] for p in ONE],
    )
    def test_is_found_quickly(self, residual, minimum, lower, upper, most):
        bounds = (None, None) if lower is None else ((lower,), (upper,))
        problem = FunctionProblem("one", residual, (1.0,), minimum, *bounds)
        NelderMead().check(make_space(problem.problem(), (0,)))
        asked = followed(problem, NelderMead())
        assert asked.solution.cost == pytest.approx(minimum, rel=1e-6, abs=1e-12)
        assert asked.solution.ending is Ending.CONVERGED
        assert asked.evaluations <= most
        assert asked.purposes[0] == "start"
        points = np.concatenate(asked.points)
        if lower is not None:
            assert (points >= lower).all()
            assert (points <= upper).all()

    def test_never_ends_above_the_start(self):
        def waves(x):
            return 2.0 + np.sin(3.0 * x) + 0.1 * (x - 8.0) ** 2

        problem = FunctionProblem("waves", waves, (7.9,), 0.0, (-30.0,), (30.0,))
        solution = problem.solve(NelderMead())
        assert solution.x[0] == pytest.approx(7.857, abs=1e-3)

    def test_stops_at_the_limit(self):
        problem = FunctionProblem("downhill", lambda x: np.exp(-x / 2.0), (1.0,), 0.0)
        assert problem.solve(NelderMead(max_iterations=5)).ending is Ending.MAX_ITERATIONS

    def test_can_be_closed_at_any_time(self):
        space = make_space(FunctionProblem("one", lambda x: x - 3.3, (1.0,), 0.0).problem(), (0,))
        search = NelderMead().search(space, np.random.default_rng(0))
        next(search)
        search.close()


def test_stops_at_the_limit_of_iterations():
    solution = ROSENBROCK.solve(NelderMead(max_iterations=3))
    assert solution.ending is Ending.MAX_ITERATIONS
    assert solution.iterations == 3
