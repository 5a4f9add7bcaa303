"""The autocorrelation of residuals and what it says of standard errors."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.stacked_noise import autoregressive, stack

from cluster_est.statistics.autocorrelation import autocorrelation


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_first_order_noise_has_the_figures_of_theory(rho):
    records = stack(20_000, 20_000)
    noise = autoregressive(records, np.array([[rho]]), np.random.default_rng(0))
    found = autocorrelation(7.0 * noise, records.items)
    assert found.lag1 == pytest.approx(rho, abs=0.02)
    assert found.widening == pytest.approx(np.sqrt((1 + rho) / (1 - rho)), rel=0.1)
    assert found.squares == pytest.approx((1 + rho**2) / (1 - rho**2), rel=0.1)


def test_no_product_spans_two_records():
    records = stack(2, 2)
    found = autocorrelation(np.array([1.0, -1.0, -1.0, 1.0]), records.items)
    assert found.lag1 == pytest.approx(-0.5)
    assert found.widening == 1.0


def test_nothing_has_no_correlation():
    for records in (stack(0), stack(1), stack(5)):
        found = autocorrelation(np.zeros(records.size), records.items)
        assert (found.lag1, found.widening, found.squares) == (0.0, 1.0, 1.0)
