"""What every cost must do. A new cost is picked up by being registered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cluster_est.costs import COSTS

RESIDUALS = arrays(np.float64, st.integers(1, 50), elements=st.floats(-1e3, 1e3))


@pytest.mark.parametrize("kind", COSTS.values(), ids=lambda k: k.name)
class TestCost:
    @given(residuals=RESIDUALS, seed=st.integers(0, 100))
    def test_order_is_irrelevant(self, kind, residuals, seed):
        shuffled = np.random.default_rng(seed).permutation(residuals)
        assert kind().value(shuffled) == pytest.approx(kind().value(residuals), rel=1e-12)

    @given(residuals=RESIDUALS)
    def test_zero_is_the_least(self, kind, residuals):
        assert kind().value(residuals) >= kind().value(np.zeros_like(residuals)) == 0.0

    @given(residuals=RESIDUALS)
    def test_sum_of_squares_is_that_of_its_terms(self, kind, residuals):
        if kind.sum_of_squares:
            terms = kind().terms(residuals)
            assert kind().value(residuals) == pytest.approx(np.sum(terms**2), rel=1e-12)

    def test_a_strided_row_gives_the_same_bits(self, kind):
        batch = np.random.default_rng(0).normal(size=(300, 7))
        for row in range(7):
            assert kind().value(batch[:, row]) == kind().value(np.array(batch[:, row]))
