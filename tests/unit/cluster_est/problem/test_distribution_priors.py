"""Priors from frozen distributions of SciPy: the most probable value, and what they refuse."""

import math

import numpy as np
import pytest
import scipy.stats as st

import cluster_est as ce
from cluster_est.errors import ProblemError
from cluster_est.problem.distribution_prior import DistributionPrior

SMOOTH = {
    "gamma": (st.gamma(3.0, scale=0.5), 1.0),  # (a - 1) scale
    "beta": (st.beta(2.0, 5.0), 0.2),  # (a - 1) / (a + b - 2)
    "t": (st.t(4, 1.0, 0.2), 1.0),
    "weibull": (st.weibull_min(2.0), math.sqrt(0.5)),
}


def prior_of(distribution, bounds=(0.0, 1.0)):
    start = 0.5 * sum(bounds)
    return ce.Parameter("k", start, bounds, prior=distribution).prior


@pytest.mark.parametrize(("distribution", "mode"), SMOOTH.values(), ids=SMOOTH)
def test_half_the_square_of_a_residual_is_the_density(distribution, mode):
    prior = DistributionPrior(distribution)
    assert prior.centre == pytest.approx(mode, rel=1e-6)
    assert prior.residual(prior.centre) == 0.0
    for value in distribution.ppf([0.02, 0.3, 0.6, 0.97]):
        expected = distribution.logpdf(prior.centre) - distribution.logpdf(value)
        assert 0.5 * prior.residual(value) ** 2 == pytest.approx(expected, rel=1e-9)
        assert np.sign(prior.residual(value)) == np.sign(value - prior.centre)
        step = 1e-6
        change = prior.residual(value + step) - prior.residual(value - step)
        assert prior.slope(value) == pytest.approx(change / (2.0 * step), rel=1e-4)
    step = 1e-3 * distribution.std()
    around = distribution.logpdf(prior.centre + step * np.array([-1.0, 0.0, 1.0]))
    bend = (around[0] - 2.0 * around[1] + around[2]) / step**2
    assert prior.slope(prior.centre) == pytest.approx(math.sqrt(-bend), rel=1e-3)


def test_those_of_a_config_are_these():
    normal, named = prior_of(st.norm(0.4, 0.1)), prior_of(st.norm(loc=0.4, scale=0.1))
    assert normal == named == ce.NormalPrior(0.4, 0.1)
    log_normal = prior_of(st.lognorm(math.log(1.5), scale=0.4))
    assert isinstance(log_normal, ce.LogNormalPrior)
    assert (log_normal.median, log_normal.factor) == pytest.approx((0.4, 1.5))


def test_a_density_of_zero_has_a_finite_residual():
    prior = prior_of(st.beta(2.0, 5.0))
    for end in (0.0, 1.0):
        assert math.isfinite(prior.residual(end))
        assert math.isfinite(prior.slope(end))
        assert math.isfinite(prior.log_density(end))


@pytest.mark.parametrize(
    ("distribution", "bounds", "said"),
    [
        (st.uniform(0.0, 1.0), (0.0, 1.0), r"one smooth mode.*uniform.*bounds=\(0.1, 10.0\)"),
        (st.expon(), (0.0, 1.0), r"one smooth mode .*, but expon\(\) has no such mode"),
        (st.laplace(0.5, 0.1), (0.0, 1.0), r"one smooth mode .*, but laplace\(0.5, 0.1\)"),
        (st.poisson(3), (0.0, 9.0), "must be a continuous distribution"),
        (st.gamma(3.0), (-1.0, 9.0), r"k.bounds: must lie where.*from 0 to inf.*\[-1, 9\]"),
        (st.gamma(3.0), (4.0, 9.0), r"k.prior: must have its centre within the bounds"),
        ("normal", (0.0, 1.0), "k.prior: must be a Prior.*'normal'"),
    ],
)
def test_what_is_no_prior_is_refused(distribution, bounds, said):
    with pytest.raises(ProblemError, match=said):
        prior_of(distribution, bounds)
