"""Simulations that fail at random in the point: a search finds the minimum, or does not claim it.

Failures are drawn from the bits of the point, so that the same point always fails.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import FunctionProblem
from support.thinning import thinned

from cluster_est.methods import LeastSquares, ScipyLeastSquares, Sqp
from cluster_est.methods.method import Ending

TIMES = np.linspace(0.0, 4.0, 41)
TRUE = np.array([0.7, 1.0, -0.4])
SIGMA = 0.01
NOISE = np.random.default_rng(5).normal(size=len(TIMES))


def decay(x):
    """The residuals of a decay with an offset, in sigmas."""
    rate, first, offset = x
    clean = TRUE[1] * np.exp(-TRUE[0] * TIMES) + TRUE[2]
    return (clean - offset - first * np.exp(-rate * TIMES)) / SIGMA + NOISE


def failing(share, seed, of):
    """The same, but a share of the values of some unknowns cannot be simulated."""

    def residuals(x):
        drawn = np.random.default_rng([seed, *np.frombuffer(x[of].tobytes(), np.uint32)]).random()
        return np.full(len(TIMES), np.nan) if drawn < share else decay(x)

    return residuals


DECAY = FunctionProblem("decay", decay, (1.5, 0.5, 0.1), 0.0, (0.05, -9.0, -9.0), (5.0, 9.0, 9.0))
METHODS = {
    "least_squares": LeastSquares(),
    "secant": LeastSquares(secant_updates=3),
    "trf": ScipyLeastSquares(),
    "dogbox": ScipyLeastSquares(algorithm="dogbox"),
    "sqp": Sqp(),
    "speculative": Sqp(speculative_gradient=True),
    "quasi-newton": Sqp(hessian="quasi_newton"),
    "slsqp": Sqp(algorithm="slsqp"),
    "trust_constr": Sqp(algorithm="trust_constr"),
}
SHARES = (0.05, 0.15, 0.3)
OF = {"the point": [0, 1, 2], "the rate": [0]}


def ended(method, share, of, seed):
    """The ending of one search, and how far it is from the minimum, in standard errors."""
    undisturbed = DECAY.solve(LeastSquares())
    scatter = np.linalg.inv(undisturbed.jacobian.T @ undisturbed.jacobian)
    start = np.array([1.5, 0.5, 0.1]) * np.random.default_rng(seed).uniform(0.5, 1.5, 3)
    disturbed = replace(DECAY, residuals=failing(share, seed, OF[of]), start=tuple(start.tolist()))
    found = disturbed.solve(METHODS[method])
    return found, np.abs(found.x - undisturbed.x) / np.sqrt(np.diag(scatter))


@pytest.mark.parametrize(
    ("method", "share", "of", "count"),
    thinned(
        [(m, share, of, 25) for m in METHODS for share in SHARES for of in OF]
        + [(m, 0.3, "the rate", 3) for m in METHODS],
        lambda m, share, of, count: count < 25 and m,
    ),
)
def test_it_converges_to_the_minimum_or_not_at_all(method, share, of, count):
    for seed in range(count):
        found, errors = ended(method, share, of, seed)
        assert not found.ending.success or errors.max() < 0.1, (seed, errors)
        assert not found.ending.success or found.frozen is None or not found.frozen.any()


@pytest.mark.parametrize("method", METHODS)
def test_most_of_them_reach_the_minimum_all_the_same(method):
    endings = [ended(method, 0.15, "the point", seed)[0].ending for seed in range(4)]
    assert endings.count(Ending.CONVERGED) + endings.count(Ending.START_FAILED) == 4


@pytest.mark.parametrize("method", METHODS)
def test_an_unknown_that_can_never_be_moved_is_named(method):
    def stuck(x):  # its offset can only be simulated where it starts
        return decay(x) if x[2] == 0.1 else np.full(len(TIMES), np.nan)

    found = replace(DECAY, residuals=stuck).solve(METHODS[method])
    assert not found.ending.success
    if method != "trust_constr":  # which starts away from the start
        assert found.ending is Ending.DERIVATIVES_MISSING
        assert "failed for 'x2'" in found.message


@pytest.mark.parametrize("method", METHODS)
def test_a_start_beside_what_cannot_be_simulated_is_left_along_it_or_not_called_a_minimum(method):
    def walled(x):  # the rate pulls upwards, where nothing can be simulated
        return decay(x) if x[0] <= 0.3 else np.full(len(TIMES), np.nan)

    found = replace(DECAY, residuals=walled, start=(0.3, 0.5, 0.1)).solve(METHODS[method])
    assert not found.ending.success
    if method in ("least_squares", "sqp"):
        along = replace(DECAY, start=(0.3, 0.5, 0.1), upper=(0.3, 9.0, 9.0)).solve(LeastSquares())
        assert found.cost == pytest.approx(along.cost, rel=1e-3)
