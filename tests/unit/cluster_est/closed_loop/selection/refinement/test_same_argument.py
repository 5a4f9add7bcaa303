"""The share of a candidate's effect that another one could bring about."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.closed_loop.selection.refinement.same_argument import explained_share

GENERATOR = np.random.default_rng(5)
BASIS = np.linalg.qr(GENERATOR.normal(size=(60, 4)))[0]


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_what_can_do_the_same_does_all_of_it(scale):
    columns = BASIS[:, :2] * [scale, 3.0]
    share, sizes = explained_share(2.0 * columns[:, 0] - 0.5 * columns[:, 1], columns, free=True)
    assert share == pytest.approx(1.0)
    np.testing.assert_allclose(sizes, [2.0, -0.5])


def test_a_part_is_the_square_of_the_cosine():
    target = 3.0 * BASIS[:, 0] + 4.0 * BASIS[:, 1]
    share, sizes = explained_share(target, 2.0 * BASIS[:, :1], free=True)
    assert share == pytest.approx(0.36)
    np.testing.assert_allclose(sizes, [1.5])


def test_what_has_no_strength_counts_as_it_is():
    target = BASIS[:, 0]
    assert explained_share(target, 1.0 * BASIS[:, :1], free=False)[0] == pytest.approx(1.0)
    assert explained_share(target, 0.5 * BASIS[:, :1], free=False)[0] == pytest.approx(0.75)
    share, sizes = explained_share(target, 3.0 * BASIS[:, :1], free=False)
    assert share == pytest.approx(-3.0)
    assert sizes.size == 0


def test_what_does_nothing_imitates_nothing():
    assert explained_share(BASIS[:, 0], np.zeros((60, 1)), free=True)[0] == 0.0
    assert explained_share(np.zeros(60), BASIS[:, :1], free=True)[0] == 0.0
