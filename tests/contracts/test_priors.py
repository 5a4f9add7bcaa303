"""What every prior must do. A new prior is picked up by being registered."""

import dataclasses
import inspect
import math

import numpy as np
import pytest

from cluster_est.errors import ProblemError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import PRIORS, LogNormalPrior, NormalPrior, Prior

EXAMPLES: dict[str, Prior] = {
    "normal": NormalPrior(2.0, 0.3),
    "lognormal": LogNormalPrior(2.0, 1.5),
}
"""One of each kind; all of them can be at 2."""


def written(base=Prior):
    """All priors of the room that are no base of others."""
    for kind in base.__subclasses__():
        yield from written(kind)
        if kind.__module__ == "cluster_est.problem.priors" and not inspect.isabstract(kind):
            yield kind


def test_every_prior_is_registered_and_has_an_example_here():
    missing = [kind.__name__ for kind in written() if kind not in PRIORS.values()]
    assert missing == [], "PRIORS lacks it: add it there, with a `name` that no other prior has"
    assert set(EXAMPLES) == set(PRIORS), "add one of its kind to EXAMPLES"


@pytest.mark.parametrize("prior", EXAMPLES.values(), ids=lambda p: p.name)
class TestPrior:
    def test_its_keys_are_the_fields_of_a_frozen_dataclass(self, prior):
        own = vars(type(prior)).get("__dataclass_params__")
        assert getattr(own, "frozen", False), "write @dataclass(frozen=True) above it"
        assert dataclasses.fields(prior)

    def test_the_residual_is_zero_at_its_centre_and_grows_on_both_sides(self, prior):
        assert prior.residual(prior.centre) == pytest.approx(0.0, abs=1e-12)
        values = prior.centre * np.linspace(0.5, 1.5, 21)
        residuals = [prior.residual(float(v)) for v in values]
        assert np.all(np.diff(residuals) > 0.0)

    def test_the_slope_is_that_of_the_residual(self, prior):
        for value in (0.7, 1.3, 2.0, 3.1):
            step = 1e-6
            quotient = (prior.residual(value + step) - prior.residual(value - step)) / (2.0 * step)
            assert prior.slope(value) == pytest.approx(quotient, rel=1e-6)

    def test_a_residual_is_finite_at_a_bound_of_zero(self, prior):
        assert math.isfinite(prior.residual(0.0))
        assert math.isfinite(prior.slope(0.0))

    def test_a_centre_beyond_the_bounds_is_refused(self, prior):
        with pytest.raises(ProblemError, match=r"parameters.k.prior: must have its centre within"):
            Parameter("k", 4.0, (3.0, 5.0), prior=prior)

    def test_it_says_what_it_is(self, prior):
        assert prior.name in prior.said()
        assert "2" in prior.said()


NORMAL, LOG_NORMAL = NormalPrior(1.0, 0.1), LogNormalPrior(1.0, 2.0)


def with_prior(prior, *values, **more):
    return Parameter("k", *values, prior=prior, **more)


def test_sixty_eight_percent_of_a_log_normal_lie_within_its_factor():
    prior = LogNormalPrior(3.0, 2.0)
    assert prior.residual(6.0) == pytest.approx(1.0)
    assert prior.residual(1.5) == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: NormalPrior(1.0, 0.0), "prior.sd: must be greater than 0"),
        (lambda: NormalPrior(math.nan, 1.0), "prior.mean: must be a finite number"),
        (lambda: LogNormalPrior(-1.0, 2.0), "prior.median: must be greater than 0"),
        (lambda: LogNormalPrior(1.0, 1.0), "prior.factor: must be greater than 1"),
        (lambda: with_prior(NORMAL, 1.0, fixed=True), "k.prior: must not be used with fixed"),
        (lambda: with_prior(LOG_NORMAL, 0.0, (0.0, 5.0)), "k.start: must be above 0.*log-normal"),
        (lambda: with_prior(LOG_NORMAL, 1.0, (-1.0, 5.0)), "k.bounds: must not be below 0.*-1"),
    ],
)
def test_a_mistake_is_met_with_a_sentence(make, said):
    with pytest.raises(ProblemError, match=said):
        make()
