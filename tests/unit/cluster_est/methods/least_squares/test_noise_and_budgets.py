from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import ROSENBROCK, FunctionExecutor, FunctionProblem, named
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est import Budget, LeastSquares
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.differences import ResidualJacobian
from cluster_est.methods.least_squares.iteration import IterationState
from cluster_est.methods.least_squares.levenberg_marquardt import secant_update
from cluster_est.methods.method import Ending, Evaluation, Progress, Solution
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status

TRUTH = 2.0
PHASES = np.linspace(0.0, 1.0, 50)
SHAPE = 1.0 + np.cos(3.0 * PHASES)


def solved(residuals, start: float = 1.0, **options) -> Solution:
    return FunctionProblem("", residuals, (start,), np.nan).solve(LeastSquares(**options))


def line(x):
    return SHAPE * (x[0] - TRUTH)


def ripple(x):
    """Far too fast for short differences."""
    return np.sin(1e9 * x[0] + 100.0 * PHASES)


@pytest.mark.parametrize("size", [1e-5, 1e-4, 1e-3, 0.01, 0.1])
def test_longer_differences_lead_through_noise(size):
    solution = solved(lambda x: line(x) + size * ripple(x))
    assert solution.ending is Ending.CONVERGED
    assert solution.x[0] == pytest.approx(TRUTH, abs=0.1 * size)
    assert "shorter steps were unreliable" in solution.message


@pytest.mark.parametrize("differences", ["forward", "auto"])
def test_nothing_has_converged_where_no_step_lowers_a_cost_that_promises_to_fall(differences):
    """At a kink, the slope to one side says that the cost falls to the other."""
    solution = solved(
        lambda x: SHAPE * (1.0 + np.abs(x[0] - TRUTH)), TRUTH, differences=differences
    )
    assert solution.x[0] == TRUTH
    assert solution.ending is Ending.STALLED


def test_without_noise_differences_stay_short():
    solution = solved(line)
    assert solution.ending.success
    assert solution.message == ""
    assert solution.x[0] == pytest.approx(TRUTH, abs=1e-12)


def test_a_minimum_within_a_fifth_of_a_standard_error_is_one():
    """Noise of this size moves nothing that the data could show: no longer differences."""
    offset = np.where(np.arange(50) % 2 == 0, 0.5, -0.5)
    solution = solved(lambda x: line(x) + offset + 1e-9 * ripple(x))
    assert solution.ending is Ending.CONVERGED
    expected = TRUTH - (SHAPE @ offset) / (SHAPE @ SHAPE)
    error = np.sqrt(offset @ offset / 49 / (SHAPE @ SHAPE))
    assert abs(solution.x[0] - expected) < 0.2 * error


def test_an_output_that_moves_in_steps_is_followed_by_longer_differences():
    """Steps of 0.01 are longer than the differences that suit a solver without noise."""
    solution = solved(lambda x: SHAPE * (np.round(100.0 * x[0] + PHASES) / 100.0 - TRUTH))
    assert solution.x[0] == pytest.approx(TRUTH, abs=0.01)


def test_unknowns_without_any_effect_do_not_converge():
    solution = solved(lambda x: 1.0 + PHASES)
    assert solution.ending is Ending.NO_EFFECT
    assert not solution.ending.success


def test_a_wall_of_failures_is_no_minimum():
    """Beyond it nothing can be simulated; derivatives are those of this side."""
    levels = np.array([4.2, 5.3, 4.6, 3.9, 4.8])
    solution = solved(lambda x: x[0] - levels if x[0] > 4.9 else np.full(5, np.nan), 5.1)
    assert solution.x[0] == pytest.approx(4.9, abs=1e-6)
    assert solution.ending is Ending.STALLED


FOUR = named("brown dennis")
FIRST, LAST = 8, 24
"""How many budgets that end in the first steps, and in the last."""
JACOBIANS = ("jacobian", "jacobian_central")
ONE_TRIAL = LeastSquares(trials=1)


def search(
    problem: FunctionProblem, method: LeastSquares, most: int | None, searches: int = 1
) -> tuple[list[Solution], list[str]]:
    """The solutions, and the purpose of each point that was simulated."""
    purposes: list[str] = []
    runner = Runner(
        FunctionExecutor(problem.residuals),
        Budget(evaluations=most),
        lambda origin, _: purposes.append(origin.purpose),
    )
    space = problem.space()
    rooms = [space.starting_at(space.start * (1.0 + 0.1 * i)) for i in range(searches)]
    requests = [SearchRequest(f"s{i}", method, room) for i, room in enumerate(rooms)]
    return runner.run(requests), purposes


@pytest.mark.parametrize("trials", [1, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("problem", [ROSENBROCK, FOUR], ids=lambda problem: problem.name)
def test_the_last_points_are_steps(problem, trials):
    method = LeastSquares(trials=trials)
    (free,), all_of_it = search(problem, method, None)
    size, costs, messages = len(problem.start), [], []
    budgets = range(2 + size, len(all_of_it))
    for most in (*budgets[:FIRST], *budgets[-LAST:]):
        (solution,), purposes = search(problem, method, most)
        costs.append(solution.cost)
        messages.append(solution.message)
        assert len(purposes) < most + trials
        if solution.ending is Ending.BUDGET:
            assert purposes[-1] not in JACOBIANS
        else:
            assert solution.ending.success
            assert solution.jacobian is not None
            assert solution.cost == pytest.approx(free.cost, rel=1e-6, abs=1e-12)
    assert messages.count("the budget was too small for more accurate derivatives") >= 2 * size - 1
    assert costs[-1] == pytest.approx(free.cost, rel=1e-3, abs=1e-9)
    start = float(np.sum(problem.residuals(np.array(problem.start)) ** 2))
    assert all(cost < start for cost in costs)


def test_it_goes_on_with_the_last_jacobian():
    _, whole = search(FOUR, ONE_TRIAL, None)
    firsts = [i for i, purpose in enumerate(whole) if purpose == "jacobian"][4::8]
    steps = 0
    for first in firsts:
        (short,), purposes = search(FOUR, ONE_TRIAL, first + 4)  # the four points, and no step
        (before,), _ = search(FOUR, ONE_TRIAL, first)
        assert not set(purposes[first:]) & set(JACOBIANS)
        assert short.ending is before.ending is Ending.BUDGET
        assert short.cost <= before.cost
        steps += short.cost < before.cost
    assert steps > len(firsts) // 2


def test_searches_that_share_a_budget_end_within_it():
    solutions, purposes = search(FOUR, LeastSquares(), 60, searches=3)
    assert {solution.ending for solution in solutions} == {Ending.BUDGET}
    assert len(purposes) <= 60 + 3 * 4
    assert purposes[-1] not in JACOBIANS


def test_after_it_no_search_asks_for_more_than_it_must():
    runner = Runner(FunctionExecutor(FOUR.residuals), Budget(evaluations=12))
    (first,) = runner.run([SearchRequest("s", ONE_TRIAL, FOUR.space())])
    assert first.ending is Ending.BUDGET
    used = runner.evaluations
    runner.run([SearchRequest("t", LeastSquares(), FOUR.space().starting_at(first.x))])
    assert runner.evaluations == used + 1


def state(x, parts, largest):
    outcomes = tuple(Outcome(i, Status.OK, part) for i, part in enumerate(parts))
    return IterationState(x, Evaluation(outcomes, 1.0), Progress(0, 1.0), largest, 1e-3)


@pytest.fixture
def case():
    """Two experiments; the last unknown acts on the second one alone."""
    generator = np.random.default_rng(0)
    blocks = (generator.normal(size=(6, 2)), generator.normal(size=(5, 3)))
    columns = (np.array([0, 1]), np.array([0, 1, 2]))
    jacobian = ResidualJacobian(
        BlockMatrix(blocks, columns, 3), np.zeros(3, bool), np.ones(3), np.zeros((0, 3))
    )
    step = generator.normal(size=3)
    before = [generator.normal(size=6), generator.normal(size=5)]
    expected = [block @ step[own] for block, own in zip(blocks, columns, strict=True)]
    after = [b + e + 0.1 * generator.normal(size=len(b))
             for b, e in zip(before, expected, strict=True)]  # fmt: skip
    return jacobian, step, before, after


@pytest.mark.parametrize("largest", [np.zeros(3), np.array([1.0, 20.0, 0.3])])
def test_it_says_what_the_step_has_shown_and_changes_nothing_else(case, largest):
    jacobian, step, before, after = case
    one, other = state(np.zeros(3), before, largest), state(step, after, largest)
    found = secant_update(jacobian, one, other)
    seen = other.at.residuals - one.at.residuals
    np.testing.assert_allclose(found.blocks.product(step), seen, atol=1e-12)
    scaled = step * (largest**2 if largest.any() else 1.0)
    for e, columns in enumerate(jacobian.blocks.columns):
        # directions that are orthogonal to the scaled step keep their derivatives
        _, _, rows = np.linalg.svd(scaled[columns][None])
        kept = rows[1:].T
        np.testing.assert_allclose(
            found.blocks.blocks[e] @ kept, jacobian.blocks.blocks[e] @ kept, atol=1e-12
        )


def test_a_step_that_showed_something_else_asks_for_new_derivatives(case):
    jacobian, step, before, _ = case
    opposite = [
        b - block @ step[own]
        for b, block, own in zip(
            before, jacobian.blocks.blocks, jacobian.blocks.columns, strict=True
        )
    ]
    one, other = state(np.zeros(3), before, np.zeros(3)), state(step, opposite, np.zeros(3))
    assert secant_update(jacobian, one, other) is None


def test_an_unknown_that_hardly_moved_shows_nothing_of_the_experiments_that_only_it_acts_on():
    """Their change is rounding; over a step of 1e-180 it would be an infinite derivative."""
    columns = (np.array([0]), np.array([1]))
    blocks = (np.ones((4, 1)), np.full((3, 1), 2.0))
    jacobian = ResidualJacobian(
        BlockMatrix(blocks, columns, 2), np.zeros(2, bool), np.ones(2), np.zeros((0, 2))
    )
    before, after = [np.zeros(4), np.zeros(3)], [np.full(4, 1.1), np.full(3, 1e-15)]
    step = np.array([1.0, 1e-180])
    one, other = state(np.zeros(2), before, np.zeros(2)), state(step, after, np.zeros(2))
    found = secant_update(jacobian, one, other)
    np.testing.assert_allclose(found.blocks.blocks[0], 1.1)
    np.testing.assert_array_equal(found.blocks.blocks[1], 2.0)


def test_a_fit_ends_where_it_does_without_them():
    problem = spring_problem(3, 100, noise=0.01).problem
    plain = ce.fit(problem)
    found = ce.fit(problem, ce.LeastSquares(trials=1, secant_updates=10))
    assert found.success
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)
    assert found.x == pytest.approx(plain.x, rel=1e-5)
    assert found.uncertainty is not None
    for one, other in zip(found.estimates, plain.estimates, strict=True):
        assert one.std_error == pytest.approx(other.std_error, rel=1e-3)


def test_they_save_simulations_where_many_unknowns_share_one_experiment():
    problem = spring_problem(1, 100, noise=0.01, local=("x0", "v0")).problem
    start = tuple(replace(p, start=p.start * 1.3 + 0.01) for p in problem.parameters)
    problem = replace(problem, parameters=start)
    counts = []
    for updates in (0, 10):
        method = ce.LeastSquares(trials=1, differences="forward", secant_updates=updates, ftol=1e-4)
        counts.append(ce.fit(problem, method).evaluations)
    assert counts[1] <= counts[0]
