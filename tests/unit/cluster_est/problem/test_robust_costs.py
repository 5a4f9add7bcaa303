import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from cluster_est.problem.costs import COST_ALIASES, COSTS

# "rho(z)" as the documentation of scipy.optimize.least_squares writes them
RHO = {
    "huber": lambda z: z if z <= 1.0 else 2.0 * z**0.5 - 1.0,
    "soft_l1": lambda z: 2.0 * ((1.0 + z) ** 0.5 - 1.0),
    "cauchy": lambda z: np.log1p(z),
}
SLOPE = {
    "huber": lambda z: 1.0 if z <= 1.0 else z**-0.5,
    "soft_l1": lambda z: (1.0 + z) ** -0.5,
    "cauchy": lambda z: 1.0 / (1.0 + z),
}
ONE = np.zeros(0, np.int64)
LIKELIHOOD = COSTS["likelihood"]
RESIDUALS = arrays(np.float64, st.integers(1, 30), elements=st.floats(-1e3, 1e3))
robust = pytest.mark.parametrize("name", list(RHO))


@robust
@given(residuals=RESIDUALS, scale=st.floats(1e-2, 1e2))
def test_values_are_those_that_scipy_documents(name, residuals, scale):
    """And the weights are the slopes of rho."""
    cost, squares = COSTS[name](scale), [(r / scale) ** 2 for r in residuals.tolist()]
    by_hand = sum(scale**2 * RHO[name](z) for z in squares)
    assert cost.value(residuals, ONE) == pytest.approx(by_hand, rel=1e-9, abs=1e-12 * scale**2)
    slopes = [SLOPE[name](z) for z in squares]
    np.testing.assert_allclose(cost.weights(residuals, ONE), slopes, rtol=1e-12)


@robust
def test_usual_residuals_count_as_squares(name):
    small = np.array([1e-9, -3e-9])
    assert COSTS[name]().value(small, ONE) == pytest.approx(1e-17, rel=1e-12)
    np.testing.assert_allclose(COSTS[name]().weights(small, ONE), [1.0, 1.0], rtol=1e-12)


@robust
@pytest.mark.parametrize("scale", [1e-100, 1e-30, 1e30, 1e99])
def test_no_scale_that_is_allowed_makes_a_cost_that_is_no_number(name, scale):
    for size in (0.0, 1e-200, 1e-8, 1.0, 1e8, 1e150, 1e200):
        residuals = np.array([size, -size])
        value = COSTS[name](scale).value(residuals, ONE)
        underflows = min(size, size / scale) < 1e-150  # its square is 0
        assert value > 0.0 or (underflows and value == 0.0), size
        weights = COSTS[name](scale).weights(residuals, ONE)
        assert np.all((weights >= 0.0) & (weights <= 1.0)), size


@pytest.mark.parametrize(("name", "value"), [("sse", 25.25), ("sae", 7.5), ("total", -0.5)])
def test_sums(name, value):
    cost = COSTS[name]()
    residuals = np.array([3.0, -4.0, 0.5])
    assert cost.value(residuals, ONE) == value
    assert (cost.weights(residuals, ONE) is None) == (name != "sse")


def test_the_names_of_other_tools():
    assert COST_ALIASES == {"SSE": "sse", "residuals": "sse", "SAE": "sae"}


def deviance(residuals, outputs):
    """-2 ln likelihood, each sigma found by SciPy's scalar minimisation."""
    total = 0.0
    for output in np.unique(outputs):
        own = residuals[outputs == output]

        def negative(log_sigma, own=own):
            return -2.0 * norm.logpdf(own, scale=np.exp(log_sigma)).sum()

        begin = np.log(np.sqrt(np.mean(own**2)))
        total += minimize_scalar(negative, (begin - 1.0, begin + 1.5), tol=1e-12).fun
    return total


@pytest.mark.parametrize("seed", range(5))
def test_the_likelihood_is_the_one_at_the_most_likely_sigmas(seed):
    generator = np.random.default_rng(seed)
    outputs = np.repeat([0, 1, 2], [20, 35, 50])
    generator.shuffle(outputs)
    sizes = np.array([1e-3, 1.0, 300.0])[outputs]
    one, other = (sizes * generator.normal(size=105) for _ in range(2))
    cost = LIKELIHOOD()
    # a constant, n (1 + ln 2 pi), is left out
    for residuals in (one, other):
        constant = 105.0 * (1.0 + np.log(2.0 * np.pi))
        assert cost.value(residuals, outputs) + constant == pytest.approx(
            deviance(residuals, outputs), rel=1e-9
        )


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-160, 1e160])
def test_residuals_of_any_size_have_a_likelihood(size):
    residuals = np.full(4, size)
    outputs = np.array([0, 0, 1, 1])
    assert not np.isnan(LIKELIHOOD().value(residuals, outputs))
    weights = LIKELIHOOD().weights(residuals, outputs)
    assert np.all(weights >= 0.0)
    assert not np.isnan(np.sqrt(weights) * residuals).any()
