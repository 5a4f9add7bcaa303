"""Residuals that jump a little from point to point, as those of an FMU with a solver of its own."""

import numpy as np
import pytest
from support.problems.functions import FunctionProblem

from cluster_est.methods import LeastSquares
from cluster_est.methods.base import Ending, Solution

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
    assert "shorter ones were doubtful" in solution.message


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
