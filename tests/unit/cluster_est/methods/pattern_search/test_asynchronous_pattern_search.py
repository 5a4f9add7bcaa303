import numpy as np
import pytest
from support.problems.functions import PROBLEMS, ROSENBROCK, FunctionProblem, named
from support.problems.method_entries import CASES, REGRESSION, ROUGHNESS, SMOOTH
from support.shuffling_executor import ShufflingExecutor
from support.thinning import thinned
from virtual_executor import VirtualExecutor

from cluster_est.methods import AsynchronousPatternSearch, Method, PatternSearch
from cluster_est.methods.method import Ending

METHOD = AsynchronousPatternSearch()
BARD = named("bard bounded")


def moody(problem: FunctionProblem, seed: int, workers: int) -> ShufflingExecutor:
    return ShufflingExecutor(problem.answer, seed, workers)


def sometimes_slow(task, generator) -> float:
    return 10.0 if generator.random() < 0.1 else 1.0


def virtual(problem: FunctionProblem, seed: int, workers: int) -> VirtualExecutor:
    constraints = problem.constraints
    return VirtualExecutor(
        lambda task: problem.residuals(task.values),
        sometimes_slow,
        workers,
        None if constraints is None else lambda task: constraints(task.values),
        seed,
    )


@pytest.mark.parametrize(
    ("make", "workers", "case"),
    thinned(
        [
            pytest.param(make, workers, case, id=f"{make.__name__}-{case}")
            for make, workers in ((moody, 3), (virtual, 8))
            for case in CASES
            if case.kind != REGRESSION
        ],
        lambda make, workers, case: (make.__name__, case.kind),
    ),
)
def test_finds_a_minimum_in_any_order(make, workers, case):
    """The order decides which one, where there are several."""
    seed = {SMOOTH: 1, ROUGHNESS: 3}.get(case.kind, 2)
    solution = case.problem.solve(METHOD, executor=make(case.problem, seed, workers))
    assert solution.at.feasible
    assert solution.ending is Ending.CONVERGED or case.kind != SMOOTH
    known = {SMOOTH: 1e-6, ROUGHNESS: case.tolerance}.get(case.kind, 1e-5)
    above = min(abs(solution.cost - m) / max(1.0, abs(m)) for m in case.minima)
    assert above <= known


def test_never_asks_for_a_point_twice_nor_leaves_the_bounds():
    executor = moody(BARD, 0, 3)
    BARD.solve(METHOD, executor=executor)
    points = np.array([task.values for task in executor.submitted])
    taken_back = set(executor.cancelled)
    kept = [t.values.tobytes() for t in executor.submitted if t.id not in taken_back]
    assert len(set(kept)) == len(kept)
    assert (points >= BARD.lower).all()
    assert (points <= BARD.upper).all()


def test_points_that_are_not_wanted_any_more_are_taken_back():
    executor = moody(ROSENBROCK, 0, 2)
    ROSENBROCK.solve(AsynchronousPatternSearch(outstanding=12), executor=executor)
    assert len(executor.cancelled) > 10
    assert executor.waiting == 0


@pytest.mark.parametrize("outstanding", [1, 3, 20])
def test_any_number_may_be_outstanding(outstanding):
    method = AsynchronousPatternSearch(outstanding=outstanding)
    solution = PROBLEMS[3].solve(method, executor=moody(PROBLEMS[3], 0, 4))
    assert solution.cost == pytest.approx(0.0, abs=1e-6)


def chain(x):
    """A valley through eight unknowns."""
    return np.concatenate([3.0 * (x[1:] - x[:-1] ** 2), 1.0 - x])


CHAIN = FunctionProblem("chain", chain, (0.5,) * 8, 0.0)


class ReachedError(Exception):
    """A cost that was aimed at."""


def time_to(target: float, method: Method, seed: int, workers: int) -> float:
    """Virtual seconds until a simulation ends whose cost is below a target."""

    def residuals(task):
        found = chain(task.values)
        if found @ found < target:
            raise ReachedError
        return found

    executor = VirtualExecutor(residuals, sometimes_slow, workers, seed=seed)
    with pytest.raises(ReachedError):
        CHAIN.solve(method, seed, executor=executor)
    return executor.now


@pytest.mark.parametrize("step", ["quadratic", pytest.param("none", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_is_sooner_where_one_simulation_in_ten_takes_ten_times_longer(step):
    methods = PatternSearch(search_step=step), AsynchronousPatternSearch(search_step=step)
    together, as_they_come = (
        np.median([time_to(1e-3, method, seed, workers=8) for seed in range(3)])
        for method in methods
    )
    assert as_they_come < 0.8 * together
