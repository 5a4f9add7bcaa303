"""That they find the minima of known problems is said by the product of methods and problems."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from support.problems.constrained import CONSTRAINED, held
from support.problems.functions import PROBLEMS, FunctionProblem, followed, named
from support.thinning import thinned

from cluster_est.methods import Sqp
from cluster_est.methods.method import Ending
from cluster_est.problem.costs import CauchyCost, HuberCost

METHODS = [
    Sqp(),
    Sqp(algorithm="slsqp", max_iterations=300),
    Sqp(algorithm="trust_constr", max_iterations=400),
]
BY_ALGORITHM = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.algorithm)
ALL = [*PROBLEMS, *CONSTRAINED]


def own_jacobian(function, x):
    """By central differences."""
    steps = np.diag(1e-6 * np.maximum(1.0, np.abs(x)))
    return np.stack([(function(x + h) - function(x - h)) / (2 * h.sum()) for h in steps], axis=1)


@pytest.mark.parametrize("hessian", ["gauss_newton", "quasi_newton"])
@pytest.mark.parametrize("name", ["rosenbrock", "bard bounded", "hs14", "hs65", "hs79"])
def test_either_curvature_alone(hessian, name):
    problem = named(name, ALL)
    solution = problem.solve(Sqp(hessian=hessian))
    assert solution.at.feasible
    assert solution.cost == pytest.approx(problem.minimum, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    "problem",
    thinned(
        [pytest.param(p, id=p.name) for p in ALL if p.minimum != 0.0],
        lambda problem: len(problem.start),
        lambda problem: (problem.cost.name, problem.equality),
    ),
)
def test_speculative_gradients_give_the_same_bits(problem):
    plain = problem.solve(Sqp())
    ahead = problem.solve(Sqp(speculative_gradient=True))
    assert ahead.x.tobytes() == plain.x.tobytes()
    assert ahead.iterations == plain.iterations


@BY_ALGORITHM
class TestSolution:
    @pytest.mark.parametrize("name", ["rosenbrock far", "bard", "hs14", "hs65", "hs6"])
    def test_has_the_jacobian_at_the_solution(self, method, name):
        problem = named(name, ALL)
        solution = problem.solve(method)
        wanted = own_jacobian(problem.residuals, solution.x)
        np.testing.assert_allclose(solution.jacobian, wanted, rtol=1e-4, atol=1e-4)
        assert (solution.difference_steps != 0.0).all()
        np.testing.assert_array_equal(solution.at.residuals, problem.residuals(solution.x))

    def test_has_none_where_the_cost_is_no_sum_over_residuals(self, method):
        assert named("hs7", ALL).solve(method).jacobian is None

    @pytest.mark.parametrize("cost", [HuberCost(0.5), CauchyCost(0.5)], ids=repr)
    def test_robust_costs_under_a_constraint(self, method, cost):
        times = np.linspace(0.0, 3.0, 30)
        measured = 2.0 * np.exp(-times) + 0.5
        measured[[4, 11, 23]] += [3.0, -4.0, 5.0]

        def residuals(x):
            return measured - x[0] * np.exp(-x[1] * times) - x[2]

        start = (1.0, 0.6, 0.1)
        problem = held("outliers", residuals, start, least=[lambda x: x[0] + x[2] - 2.2], cost=cost)
        wanted = minimize(
            lambda x: cost.value(residuals(x), np.zeros(30, np.int64)),
            start,
            method="SLSQP",
            constraints={"type": "ineq", "fun": lambda x: 2.2 - x[0] - x[2]},
            options={"ftol": 1e-14},
        )
        solution = problem.solve(method)
        assert solution.cost == pytest.approx(wanted.fun, rel=1e-6)
        np.testing.assert_allclose(solution.x, wanted.x, atol=1e-3)

    def test_units_do_not_matter(self, method):
        problem, units = named("hs65", ALL), np.array([1e6, 1e-4, 1.0])
        scaled = replace(
            problem,
            residuals=lambda x: 1e3 * problem.residuals(x / units),
            constraints=lambda x: problem.constraints(x / units),
            start=tuple(units * problem.start),
            lower=tuple(units * problem.lower),
            upper=tuple(units * problem.upper),
        )
        solution = scaled.solve(method)
        assert solution.cost == pytest.approx(1e6 * problem.minimum, rel=1e-6)


def test_follows_the_crease_of_a_constraint_that_is_the_largest_of_several():
    """The best point lies where the first two of its three faces meet."""
    faces = [lambda x: max(x[0] ** 2 - x[1], x[0] + x[1] - 1.5, -x[0] - x[1] ** 2)]
    problem = held("crease", lambda x: x - np.array([3.0, 1.0]), (0.0, 3.0), least=faces)
    found = followed(problem, Sqp())
    meeting = (7.0**0.5 - 1.0) / 2.0  # where x0^2 = x1 and x0 + x1 = 1.5
    assert found.solution.ending.success
    assert found.solution.at.feasible
    np.testing.assert_allclose(found.solution.x, [meeting, 1.5 - meeting], rtol=1e-7)
    assert len(found.points) < 100


def nothing(x):
    """The residuals of a problem without data, whose cost is 0: only constraints count."""
    return np.zeros(0)


class TestFeasibilityOnly:
    @BY_ALGORITHM
    def test_ends_at_the_first_point_that_satisfies_all_constraints(self, method):
        limits = [lambda x: 0.25 * x[0] ** 2 + x[1] ** 2 - 1.0, lambda x: x[0] - 2.0 * x[1] + 1.0]
        problem = held("no data", nothing, (2.0, 2.0), least=limits)
        found = followed(problem, method)
        assert found.solution.ending is Ending.CONVERGED
        assert found.solution.at.feasible
        assert found.solution.cost == 0.0
        good = [i for i, x in enumerate(found.points) if (problem.constraints(x) <= 1e-6).all()]
        assert good[0] == len(found.points) - 1

    @BY_ALGORITHM
    def test_a_start_that_satisfies_them_is_all_it_asks_for(self, method):
        found = followed(held("no data", nothing, (0.5,), least=[lambda x: x[0] - 1.0]), method)
        assert found.solution.x == [0.5]
        assert found.solution.ending is Ending.CONVERGED
        assert len(found.points) == 1

    def test_equalities(self):
        circle_and_line = [lambda x: x @ x - 4.0, lambda x: x[0] + x[1] - 1.0]
        problem = held("no data", nothing, (2.0,) * 5, equal=circle_and_line)
        solution = problem.solve(Sqp())
        assert solution.ending is Ending.CONVERGED
        np.testing.assert_allclose(problem.constraints(solution.x), 0.0, atol=1e-6)


class TestFailures:
    @BY_ALGORITHM
    def test_contradicting_constraints_are_named(self, method):
        both = [lambda x: x[0] + 1.0, lambda x: 1.0 - x[0], lambda x: x[1] - 1.0]
        solution = held("impossible", lambda x: x - 3.0, (0.2, 0.1), least=both).solve(method)
        creeps = method.algorithm == "trust_constr"  # and reaches the limit of iterations
        assert solution.ending is (Ending.MAX_ITERATIONS if creeps else Ending.INFEASIBLE)
        assert "'c0 [e]'" in solution.message or "'c1 [e]'" in solution.message

    def test_an_infeasible_problem_ends_where_the_violation_is_least(self):
        problem = held("impossible", lambda x: x - 3.0, (3.0, 3.0), least=[lambda x: x @ x + 0.5])
        solution = problem.solve(Sqp())
        assert solution.ending is Ending.INFEASIBLE
        assert solution.at.violation == pytest.approx(0.5, abs=1e-3)
        assert "'c0 [e]' is violated most, by 0.5" in solution.message

    def test_a_failed_derivative_freezes_its_unknown(self):
        def broken(x):  # its second unknown can only be simulated where it starts
            return x - np.array([1.0, 4.0]) if x[1] == 2.0 else np.full(2, np.nan)

        solution = FunctionProblem("frozen", broken, (5.0, 2.0), 4.0).solve(Sqp())
        np.testing.assert_allclose(solution.x, [1.0, 2.0], atol=1e-7)

    def test_no_derivative_at_all(self):
        def residuals(x):
            return x if (x == 1.0).all() else np.full(2, np.nan)

        needle = FunctionProblem("needle", residuals, (1.0, 1.0), 0.0)
        assert needle.solve(Sqp()).ending is Ending.DERIVATIVES_FAILED

    @BY_ALGORITHM
    def test_a_start_without_constraints_says_why(self, method):
        solution = held("broken", lambda x: x - 1.0, (2.0,), least=[lambda x: np.nan]).solve(method)
        assert solution.ending is Ending.START_FAILED
        assert solution.message

    def test_a_constraint_without_value_next_to_the_point_freezes_the_unknown(self):
        edge = [lambda x: x[0] - 2.0 if x[1] == 1.0 else np.nan]
        problem = held("edge", lambda x: x - np.array([3.0, 5.0]), (0.5, 1.0), 17.0, least=edge)
        np.testing.assert_allclose(problem.solve(Sqp()).x, [2.0, 1.0], atol=1e-6)

    @BY_ALGORITHM
    def test_a_constraint_that_jumps_does_no_harm(self, method):
        step = [lambda x: 1.0 if x[0] > 2.0 else -1.0]
        problem = held("step", lambda x: x - np.array([3.0, 1.0]), (0.0, 0.0), least=step)
        solution = problem.solve(method)
        assert solution.at.feasible
        assert solution.cost < 10.0
