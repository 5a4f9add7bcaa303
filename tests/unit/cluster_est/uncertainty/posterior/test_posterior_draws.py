from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import lognorm, norm
from support.problems.curves import Curves

from cluster_est import Parameter
from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS
from cluster_est.problem.priors import LogNormalPrior, NormalPrior
from cluster_est.uncertainty import UncertaintySettings, check_posterior, examine, sample_posterior
from cluster_est.uncertainty.posterior import autocorrelation_times, split_shrink_factors

TIMES = np.linspace(0.0, 1.0, 60)


def line(times, values, experiment):
    return values[0] + values[1] * times


SIGMA = 1.0 + 1e-9
"""1 itself stands for none."""


declared = partial(Curves, sigma=SIGMA)


def drawn(curves, steps=2500, seed=0, runner=None, wide=None):
    """Draw around a fit, from walkers as wide as its errors are, or `wide`."""
    own, space, solution = curves.solve()
    around = examine(own, space, solution).intervals
    if wide is not None:
        around, solution = [replace(around[0], std_error=wide)], replace(solution, jacobian=None)
    settings, generator = UncertaintySettings(posterior=steps), np.random.default_rng(seed)
    return sample_posterior(runner or own, space, solution, around, settings, generator)


def measured(seed=0):
    return [1.4 - 0.5 * TIMES + np.random.default_rng(seed).normal(size=len(TIMES))]


def lines(a=(1.0, (-10.0, 10.0)), b=(0.0, (-10.0, 10.0)), formula=line, **options):
    """Noise around a line; starts and bounds of its two parameters."""
    own = (Parameter("a", *a), Parameter("b", *b))
    return declared(formula, own, TIMES, measured(), **options)


def level(times, values, experiment):
    return values[0] + 0.0 * times


def levels(*, upper=10.0, prior=None, **options):
    own = (Parameter("a", 1.0, (-10.0, upper), prior=prior),)
    return declared(level, own, TIMES, measured(), **options)


def test_a_linear_gaussian_problem_has_the_posterior_of_linear_algebra():
    means, sds = np.array([1.5, -0.4]), np.array([0.2, 0.3])
    own = tuple(
        Parameter(name, 1.0, (-50.0, 50.0), prior=NormalPrior(float(m), float(s)))
        for name, m, s in zip("ab", means, sds, strict=True)
    )
    records = measured()
    found = drawn(declared(line, own, TIMES, records), steps=1500)
    columns = np.column_stack([np.ones(len(TIMES)), TIMES])
    precision = columns.T @ columns + np.diag(sds**-2)
    mean = np.linalg.solve(precision, columns.T @ records[0] + means / sds**2)
    covariance = np.linalg.inv(precision)
    assert found.mixed
    for i, interval in enumerate(found.intervals):
        error = np.sqrt(covariance[i, i])
        assert interval.mean == pytest.approx(mean[i], abs=0.05 * error)
        assert interval.std_error == pytest.approx(error, rel=0.05)
        assert interval.lower == pytest.approx(mean[i] - 1.96 * error, abs=0.15 * error)
        assert interval.upper == pytest.approx(mean[i] + 1.96 * error, abs=0.15 * error)
        assert interval.effective > 500
    draws = found.values.reshape(-1, 2)
    correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(correlation, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-3, 1.0])
def test_ten_unknowns_of_any_size_have_their_own_spread(size):
    """Of a standard normal in each direction, which moves along differences must not change."""
    times = np.arange(10.0)
    own = tuple(Parameter(f"p{i}", 0.0, (-10.0 * size, 10.0 * size)) for i in range(10))

    def each(times, values, experiment):
        return np.asarray(values) / size

    found = drawn(declared(each, own, times, [np.zeros(10)]), steps=2500)
    spread = found.values.std(axis=(0, 1)) / size
    assert spread == pytest.approx(np.ones(10), abs=0.08)
    assert spread.mean() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
def test_walkers_of_a_value_that_the_bounds_alone_hold_are_spread_between_them(seed):
    own = (Parameter("a", 0.5, (0.0, 1.0)),)
    faint = declared(lambda t, values, e: 1.4 + 0.002 * values[0] * t, own, TIMES, measured())
    found = drawn(faint, steps=600, seed=seed)
    assert found.mixed
    assert 0.0 <= found.values.min() <= found.values.max() <= 1.0
    shares = np.histogram(found.values, 4, (0.0, 1.0))[0] / found.values.size
    assert shares == pytest.approx(np.full(4, 0.25), abs=0.05)


NORMAL = NormalPrior(2.0, 0.4), norm(2.0, 0.4)
LOGNORMAL = LogNormalPrior(2.0, 1.3), lognorm(np.log(1.3), scale=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize(("prior", "distribution"), [NORMAL, LOGNORMAL])
def test_what_no_measurement_tells_is_drawn_from_its_prior(prior, distribution, scale):
    own = (Parameter("b", 1.5, (0.001, 50.0), scale, prior=prior),)
    flat = declared(lambda t, values, e: 1.4 + 0.0 * values[0] * t, own, TIMES, measured())
    found = drawn(flat, steps=1000)
    assert found.mixed
    shares = np.linspace(0.05, 0.95, 10)
    quantiles = np.quantile(found.values, shares)
    assert distribution.cdf(quantiles) == pytest.approx(shares, abs=0.04)


def test_the_same_seed_gives_the_same_bits_and_another_one_others():
    first, again, other = (drawn(lines(), steps=50, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.values, again.values)
    assert not np.array_equal(first.values, other.values)


def test_chains_that_are_too_short_have_no_interval_and_say_how_long_they_must_be():
    found = drawn(lines(), steps=60)
    assert not found.mixed
    assert all(np.isnan([each.lower, each.upper, each.mean]).all() for each in found.intervals)
    (said,) = found.sentences
    assert "there is no interval, because the chains are too short: draws of " in said
    assert int(said.rpartition("uncertainty.posterior to at least ")[2]) > 100


def test_walkers_in_two_minima_have_no_interval():
    records = [9.0 + 0.5 * np.random.default_rng(0).normal(size=len(TIMES))]
    own = (Parameter("a", 3.0, (-10.0, 10.0)),)
    either = declared(lambda t, values, e: values[0] ** 2 + 0.0 * t, own, TIMES, records)
    found = drawn(either, steps=400, wide=4.0)
    assert not found.mixed
    assert "no interval" in found.sentences[0]


def test_walkers_without_a_density_end_at_once_and_say_so():
    failing = replace(levels(), formula=lambda times, values, experiment: np.nan * times)
    found = drawn(levels(), steps=1000, runner=failing.runner())
    assert found.asked == 16
    (said,) = found.sentences
    assert "no draws, because none of the 16 walkers began at a point with a finite density" in said


def test_points_that_cannot_be_simulated_have_no_density_and_are_counted():
    rooted = lines(
        (1.0, (-10.0, 10.0)), (0.1, (-1.0, 10.0)), lambda t, v, e: v[0] + np.sqrt(v[1]) * t
    )
    found = drawn(rooted, steps=200)
    assert found.failures > 0
    assert found.values[:, :, 1].min() >= 0.0
    said = f"{found.failures:,} of {found.asked:,} points could not be simulated"
    assert any(said in sentence for sentence in found.sentences)


class TestDiagnostics:
    def test_the_autocorrelation_time_of_an_autoregression(self):
        """(1 + a) / (1 - a) for x' = a x + noise."""
        generator = np.random.default_rng(1)
        chain = np.zeros((8000, 8, 2))
        for n in range(1, len(chain)):
            step = generator.normal(size=(8, 2))
            chain[n] = np.array([0.0, 0.9]) * chain[n - 1] + step
        assert autocorrelation_times(chain) == pytest.approx([1.0, 19.0], rel=0.1)

    def test_what_never_moves_has_no_time(self):
        chain = np.random.default_rng(0).normal(size=(100, 8, 1))
        chain[:, 3] = 0.5  # one of the walkers is enough
        assert np.isinf(autocorrelation_times(chain)).all()
        chain = np.ones((100, 8, 1))
        assert np.isinf(autocorrelation_times(chain)).all()
        assert np.isinf(split_shrink_factors(chain)).all()

    def test_the_shrink_factor_is_one_for_chains_that_tell_the_same(self):
        chain = np.random.default_rng(2).normal(size=(2000, 8, 1))
        assert split_shrink_factors(chain) == pytest.approx([1.0], abs=0.002)
        chain[:, :4] += 2.0
        assert split_shrink_factors(chain)[0] > 1.3
        drifting = chain * 0.1 + np.linspace(0.0, 3.0, 2000)[:, None, None]
        assert split_shrink_factors(drifting)[0] > 1.5


@pytest.mark.parametrize(
    ("curves", "walkers", "said"),
    [
        (levels(cost=COSTS["sae"]()), 0, 'must be used with the cost "sse" or "likelihood"'),
        (Curves(level, levels().parameters, TIMES, measured()), 0, "sigma.y0 is missing"),
        (levels(upper=np.inf), 0, "parameters.a: must have finite bounds or a prior"),
        (lines(constraints=("a + b = 1",)), 0, "no draw satisfies the equality 'a . b = 1'"),
        (levels(), 4, "uncertainty.walkers: must be at least 8"),
    ],
    ids=["no likelihood", "no sigma", "no bounds", "equality", "few walkers"],
)
def test_what_has_no_posterior_is_refused(curves, walkers, said):
    with pytest.raises(ProblemError, match=said):
        check_posterior(curves.space(), walkers=walkers)


def test_the_package_that_draws_is_asked_for_before_anything_is_simulated(monkeypatch):
    monkeypatch.setattr("cluster_est.uncertainty.posterior.find_spec", lambda _: None)
    with pytest.raises(ProblemError, match=r"needs emcee.*pip install 'cluster-est\[posterior\]'"):
        check_posterior(levels().space())


def test_bounds_and_a_sigma_or_a_prior_or_a_likelihood_are_not_refused():
    check_posterior(levels().space())
    check_posterior(levels(upper=np.inf, prior=NormalPrior(0.0, 3.0)).space())
    likely = Curves(level, levels().parameters, TIMES, measured(), cost=COSTS["likelihood"]())
    check_posterior(likely.space())
