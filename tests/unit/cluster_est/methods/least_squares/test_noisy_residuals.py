"""Residuals that jump a little from point to point, as those of an FMU with a solver of its own."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.functions import FunctionProblem

from cluster_est.methods.base import Ending
from cluster_est.methods.least_squares.method import LeastSquares

TRUTH = 2.0
PHASES = np.linspace(0.0, 1.0, 50)
SHAPE = 1.0 + np.cos(3.0 * PHASES)


def noisy(size: float, rate: float = 1e9) -> FunctionProblem:
    """A line through TRUTH, with a ripple that is far too fast for short differences."""

    def residuals(x):
        ripple = np.sin(rate * x[0] + 100.0 * PHASES)
        return SHAPE * (x[0] - TRUTH) + size * ripple

    return FunctionProblem("noisy", residuals, (1.0,), np.nan)


@pytest.mark.parametrize("size", [1e-5, 1e-4, 1e-3, 0.01, 0.1])
def test_longer_differences_lead_through_noise(size):
    solution = noisy(size).solve(LeastSquares())
    assert solution.ending is Ending.CONVERGED
    assert solution.x[0] == pytest.approx(TRUTH, abs=0.1 * size)
    assert "shorter ones were doubtful" in solution.message


@pytest.mark.parametrize("differences", ["forward", "auto"])
def test_nothing_has_converged_where_no_step_lowers_a_cost_that_promises_to_fall(differences):
    """At a kink, the slope to one side says that the cost falls to the other."""

    def residuals(x):
        return SHAPE * (1.0 + np.abs(x[0] - TRUTH))

    problem = FunctionProblem("kink", residuals, (TRUTH,), np.nan)
    solution = problem.solve(LeastSquares(differences=differences))
    assert solution.x[0] == TRUTH
    assert solution.ending is Ending.STALLED


def test_without_noise_differences_stay_short():
    solution = noisy(0.0).solve(LeastSquares())
    assert solution.ending.success
    assert solution.message == ""
    assert solution.x[0] == pytest.approx(TRUTH, abs=1e-12)


def test_a_minimum_within_a_fifth_of_a_standard_error_is_one():
    """Noise of this size moves nothing that the data could show: no longer differences."""
    offset = np.where(np.arange(50) % 2 == 0, 0.5, -0.5)

    def residuals(x):
        return SHAPE * (x[0] - TRUTH) + offset + 1e-9 * np.sin(1e9 * x[0] + 100.0 * PHASES)

    solution = FunctionProblem("offset", residuals, (1.0,), np.nan).solve(LeastSquares())
    assert solution.ending is Ending.CONVERGED
    expected = TRUTH - (SHAPE @ offset) / (SHAPE @ SHAPE)
    error = np.sqrt(offset @ offset / 49 / (SHAPE @ SHAPE))
    assert abs(solution.x[0] - expected) < 0.2 * error


def test_an_output_that_moves_in_steps_is_followed_by_longer_differences():
    """Steps of 0.01 are longer than the differences that suit a solver without noise."""

    def residuals(x):
        return SHAPE * (np.round(100.0 * x[0] + PHASES) / 100.0 - TRUTH)

    solution = FunctionProblem("steps", residuals, (1.0,), np.nan).solve(LeastSquares())
    assert solution.x[0] == pytest.approx(TRUTH, abs=0.01)


def test_unknowns_without_any_effect_do_not_converge():
    def residuals(x):
        return 1.0 + PHASES

    solution = FunctionProblem("dead", residuals, (1.0,), np.nan).solve(LeastSquares())
    assert solution.ending is Ending.NO_EFFECT
    assert not solution.ending.success


def test_a_wall_of_failures_is_no_minimum():
    """Beyond it nothing can be simulated, so one side of the last difference fails."""
    levels = np.array([4.2, 5.3, 4.6, 3.9, 4.8])

    def residuals(x):
        return x[0] - levels if x[0] > 4.9 else np.full(5, np.nan)

    solution = FunctionProblem("wall", residuals, (5.1,), np.nan).solve(LeastSquares())
    assert solution.x[0] == pytest.approx(4.9, abs=1e-6)
    assert solution.ending is Ending.DERIVATIVES_FAILED
