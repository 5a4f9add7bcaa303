"""Residuals of outputs that are known up to scale and offset, or down to a detection limit."""

import numpy as np
import pytest
from scipy.stats import norm

from cluster_est import Output
from cluster_est.errors import DataError
from workers.residuals.observed import observed_residuals, scale_and_offset

TIMES = np.arange(30.0)
SIMULATED = 1.0 + np.sin(0.3 * TIMES)


def output(values, **how):
    return Output("y", TIMES, values, 0.2, **how)


@pytest.mark.parametrize(
    ("how", "scale", "offset"),
    [
        ({"free_scale": True}, 2.5, 0.0),
        ({"free_offset": True}, 1.0, -0.7),
        ({"free_scale": True, "free_offset": True}, 2.5, -0.7),
    ],
)
def test_the_scale_and_offset_that_made_the_data_are_found(how, scale, offset):
    made = output(scale * SIMULATED + offset, **how)
    assert scale_and_offset(made, SIMULATED) == pytest.approx((scale, offset))
    np.testing.assert_allclose(observed_residuals(made, SIMULATED), 0.0, atol=1e-12)


@pytest.mark.parametrize("relative", [0.0, 0.3])
def test_they_are_those_of_weighted_least_squares(relative):
    values = np.random.default_rng(3).normal(size=30)
    made = Output("y", TIMES, values, 0.2, relative, free_scale=True, free_offset=True)
    tall = np.column_stack([SIMULATED, np.ones(30)]) / made.sigmas[:, None]
    expected = np.linalg.lstsq(tall, values / made.sigmas)[0]
    np.testing.assert_allclose(scale_and_offset(made, SIMULATED), expected, rtol=1e-10)


def test_a_simulation_that_does_not_move_has_no_scale():
    made = output(SIMULATED, free_scale=True, free_offset=True)
    scale, offset = scale_and_offset(made, np.full(30, 4.0))
    assert scale == 0.0
    assert offset == pytest.approx(SIMULATED.mean())


def test_what_is_not_free_stays():
    made = output(SIMULATED + 1.0)
    assert scale_and_offset(made, SIMULATED) == (1.0, 0.0)
    np.testing.assert_allclose(observed_residuals(made, SIMULATED), 5.0)


def test_a_value_below_the_limit_counts_by_its_probability():
    values = np.where(SIMULATED > 1.0, SIMULATED, 0.0)
    residuals = observed_residuals(output(values, detection_limit=1.0), SIMULATED)
    hidden = values <= 1.0
    expected = -2.0 * norm.logcdf((1.0 - SIMULATED[hidden]) / 0.2)
    np.testing.assert_allclose(residuals[hidden] ** 2, expected, rtol=1e-10)
    np.testing.assert_allclose(residuals[~hidden], 0.0, atol=1e-12)


def test_far_below_the_limit_nothing_counts_and_far_above_it_does_without_overflow():
    made = output(np.zeros(30), detection_limit=1.0)
    np.testing.assert_allclose(observed_residuals(made, np.full(30, -50.0)), 0.0, atol=1e-12)
    above = observed_residuals(made, np.full(30, 1e6))
    assert np.isfinite(above).all()
    assert (above < -1e6).all()


def test_a_limit_and_a_free_scale_exclude_each_other():
    with pytest.raises(DataError, match="must not be used with free_scale or free_offset"):
        output(SIMULATED, detection_limit=0.0, free_scale=True)
