"""What every method must do, as a product of all methods and classical problems.

A new method joins by an entry in `method_entries.ENTRIES`.
"""

from dataclasses import MISSING, fields, replace

import numpy as np
import pytest
from support.problems.functions import ROSENBROCK, WALLED, FunctionProblem, rosenbrock
from support.problems.method_entries import CASES, ENTRIES, EQUALITY, INEQUALITY, boxed, excuse
from support.problems.nist import MODELS, read
from support.thinning import thinned

from cluster_est.errors import ProblemError
from cluster_est.methods import SEARCH_METHODS, LeastSquares, Nsga2, ScipyLeastSquares
from cluster_est.methods.method import Ending, GivenPoints, Points, Solution

PRODUCT = thinned(
    [
        pytest.param(entry, case, id=f"{entry}-{case}")
        for entry in ENTRIES
        for case in sorted(CASES, key=lambda case: len(case.problem.start))
        if case.kind in entry.kinds
        and not (entry.method.needs_residuals and case.problem.cost.name == "total")
        and not excuse(entry, case)
    ],
    lambda entry, case: (str(entry), str(case) if entry.quick else case.kind),
    lambda entry, case: str(case),
)


def test_every_registered_method_is_tested():
    tested, registered = {type(entry.method) for entry in ENTRIES}, set(SEARCH_METHODS.values())
    assert registered <= tested, "add an entry to ENTRIES in method_entries.py"
    assert tested <= registered, "add it to SEARCH_METHODS, under a name that no other method has"


@pytest.mark.parametrize("name", SEARCH_METHODS)
def test_a_method_is_called_what_the_config_calls_it(name):
    assert SEARCH_METHODS[name].name == name, "METHODS and the class name it differently"


@pytest.mark.parametrize("method", SEARCH_METHODS.values(), ids=lambda method: method.__name__)
def test_registered_options_are_the_fields_of_a_frozen_dataclass_with_defaults(method):
    own = vars(method).get("__dataclass_params__")
    assert getattr(own, "frozen", False), "write @dataclass(frozen=True) above it"
    bare = [f.name for f in fields(method) if f.default is MISSING and f.default_factory is MISSING]
    assert bare == [], "each option needs a default, as in NAME: int = field(default=32)"


def methods_on(kind):
    """The methods that the product has on this kind of problem, which must not be empty."""
    assert any(case.kind == kind for case in CASES)
    return {type(entry.method) for entry in ENTRIES if kind in entry.kinds}


def test_methods_that_claim_to_keep_constraints_are_tested_with_constraints_and_no_others():
    claimed = {method for method in SEARCH_METHODS.values() if method.keeps_constraints}
    # gives a front, not a minimum: its own tests cut the front with a constraint
    assert methods_on(INEQUALITY) == claimed - {Nsga2}, (
        "a method whose keeps_constraints is True has INEQUALITY among the kinds of its entry in "
        "ENTRIES, and no other has"
    )
    refused = {method for method in claimed if not method.keeps_equality}
    assert methods_on(EQUALITY) == claimed - refused, (
        "a method whose keeps_constraints and keeps_equality are True has EQUALITY among the kinds "
        "of its entry in ENTRIES, and no other has"
    )


class TestProduct:
    @pytest.mark.parametrize(("entry", "case"), PRODUCT)
    def test_finds_the_minimum_within_the_bounds(self, entry, case):
        seen = []

        def watched(x):
            seen.append(x.copy())
            return case.problem.residuals(x)

        problem = replace(chosen(entry, case.problem), residuals=watched)
        solution = problem.solve(entry.method)
        points = np.array(seen)
        inside = points >= np.array(problem.lower or -np.inf)
        inside &= points <= np.array(problem.upper or np.inf)
        assert inside.all(), "clip the points to space.lower and space.upper"
        if isinstance(entry.method, ScipyLeastSquares):  # it gives no evaluation back
            assert solution.at is None
        else:
            assert solution.at is not None, "return Solution(..., at=evaluation), that of its x"
            assert solution.at.feasible, "compare points by `rank`: this one breaks a constraint"
            assert solution.at.cost == solution.cost, "`at` must be the evaluation at the best x"
        allowed = case.tolerance + entry.accuracy_on(case) * case.scale
        nearest = min(case.minima, key=lambda minimum: abs(solution.cost - minimum))
        assert solution.cost == pytest.approx(nearest, rel=1e-7, abs=allowed), (
            f"its entry allows {entry.accuracy_on(case):.1e} of how far the start is from the "
            f"minimum, and it left {abs(solution.cost - nearest) / case.scale:.1e}"
        )


class TestRegressions:
    @pytest.mark.parametrize("name", MODELS)
    def test_least_squares_solves_all_of_nist_from_the_near_start(self, name):
        regression = read(name)
        solution = regression.problem(2).solve(LeastSquares(max_iterations=300))
        assert regression.digits(solution.x) >= 6.0

    @pytest.mark.slow
    def test_least_squares_solves_no_fewer_from_the_far_start_than_scipy(self):
        def solved(method):
            regressions = [read(name) for name in MODELS]
            return sum(r.digits(r.problem(1).solve(method).x) > 6.0 for r in regressions)

        own = solved(LeastSquares(max_iterations=300))
        assert own >= solved(ScipyLeastSquares())
        assert own >= solved(ScipyLeastSquares(algorithm="lm"))


CHANCE = "the same seed must give the same search: draw from `generator` alone, never np.random"
ORDER = (
    "a method must not ask how many workers there are, or which of them answered first (but "
    "correct test_same_seed_same_bits before, where that fails too)"
)


@pytest.mark.parametrize(
    "entry",
    thinned(
        [pytest.param(entry, id=str(entry)) for entry in ENTRIES if entry.kinds],
        lambda entry: (entry.method.name, getattr(entry.method, "algorithm", "")),
    ),
)
class TestSearch:
    def test_can_be_closed_at_any_time(self, entry):
        problem = chosen(entry, ROSENBROCK)
        search = entry.method.search(problem.space(), np.random.default_rng(0))
        assert isinstance(next(search), Points), "`search` must yield Points(x, purpose)"
        search.close()

    def test_a_failed_start_is_a_solution_that_says_so(self, entry):
        broken = FunctionProblem("broken", lambda x: np.array([np.nan, 1.0]), (1.0, 1.0), 0.0)
        solution = chosen(entry, broken).solve(entry.method)
        said = (
            "where the start is not `ok`, return Solution(x, nan, Ending.START_FAILED, at.reason)"
        )
        assert isinstance(solution, Solution), said
        assert solution.ending is Ending.START_FAILED, said
        assert "not finite" in solution.message, said

    def test_failed_trials_do_not_end_the_search(self, entry):
        solution = chosen(entry, WALLED).solve(entry.method)
        assert solution.cost == pytest.approx(0.0, abs=max(1e-6, 24.2 * entry.accuracy)), (
            f"it left {solution.cost / 24.2:.1e}, more than its entry allows: a point that "
            "failed has a cost of NaN, so compare by `rank`, and go on"
        )

    def test_it_ends_at_its_limit_of_iterations(self, entry):
        limit = {each.name for each in fields(entry.method)} & {"max_iterations", "max_generations"}
        if not limit:
            pytest.skip("it has no limit of iterations")
        short = replace(entry.method, **dict.fromkeys(limit, 3))
        solution = chosen(entry, ROSENBROCK).solve(short)
        assert solution.ending is Ending.MAX_ITERATIONS
        # one that is asynchronous counts its answers, in polls
        assert solution.iterations <= 3 or entry.method.asynchronous

    def test_same_seed_same_bits(self, entry):
        first, second = (chosen(entry, ROSENBROCK).solve(brief(entry), seed=7) for _ in range(2))
        assert first.x.tobytes() == second.x.tobytes(), CHANCE
        assert first.iterations == second.iterations, CHANCE

    def test_workers_and_the_order_of_their_answers_change_no_bit(self, entry):
        if entry.method.asynchronous:
            pytest.skip("it says that its result may depend on the order")
        problem, method = chosen(entry, ROSENBROCK), brief(entry)
        alone, together = (problem.solve(method, seed=7, workers=count) for count in (1, 3))
        assert alone.x.tobytes() == together.x.tobytes(), ORDER
        assert alone.iterations == together.iterations, ORDER

    def test_units_of_the_unknowns_do_not_matter(self, entry):
        scale = np.array([2.0**20, 2.0**-13])
        start = tuple(np.array(ROSENBROCK.start) * scale)
        box = chosen(entry, ROSENBROCK)
        bounds = [None if b is None else tuple(np.array(b) * scale) for b in (box.lower, box.upper)]
        scaled = FunctionProblem("scaled", lambda x: rosenbrock(x / scale), start, 0.0, *bounds)
        plain = box.solve(brief(entry))
        found = scaled.solve(brief(entry)).x / scale
        said = "take steps in units of space.typical, or of the room between the bounds"
        np.testing.assert_allclose(found, plain.x, rtol=1e-6, err_msg=said)

    def test_scaling_the_residuals_does_not_matter(self, entry):
        plain = chosen(entry, ROSENBROCK)
        scaled = replace(plain, residuals=lambda x: 2.0**20 * rosenbrock(x))
        found, expected = (each.solve(brief(entry)).x for each in (scaled, plain))
        said = "compare costs with each other or by their ratio, never with a number of your own"
        np.testing.assert_allclose(found, expected, rtol=1e-9, err_msg=said)

    def test_without_bounds_it_refuses_or_finds_something_finite(self, entry):
        """A method that spreads points between bounds must say in `check` that it needs them."""
        unbounded = replace(ROSENBROCK, lower=None, upper=None)
        if entry.method.needs_bounds:
            said = refusal(entry.method, unbounded.space())
            assert "bounds: must be finite" in said, (
                "needs_bounds is True: `check` must raise a ProblemError that says `bounds: must "
                "be finite`, as that of methods/populations/method.py does"
            )
            return
        found = unbounded.solve(entry.method)
        start = GivenPoints(np.array([ROSENBROCK.start]), "start")
        said = "if it cannot search without bounds, set needs_bounds and refuse them in `check`"
        assert np.isfinite(found.x).all(), said
        assert found.cost <= unbounded.solve(start).cost, said


def refusal(method, space):
    """What `check` says against a space; empty if nothing."""
    try:
        method.check(space)
    except ProblemError as error:
        return str(error)
    return ""


def brief(entry):
    """With few iterations where these are slow: what holds for some, holds for more."""
    few = {"max_generations": 10, "max_iterations": 30}
    known = {each.name for each in fields(entry.method)} & set(few)
    return entry.method if entry.quick else replace(entry.method, **{k: few[k] for k in known})


def chosen(entry, problem):
    """The problem as the method needs it."""
    return boxed(problem) if entry.boxed else problem
