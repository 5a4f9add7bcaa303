"""The share of a candidate's effect that another one could bring about."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import made_problem

from cluster_est.closed_loop.selection.refinement.same_argument import (
    explained_share,
    rise_of_criterion,
)
from cluster_est.statistics.records import make_records

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


def rise(left, target, columns, *, free=True):
    records = make_records(made_problem(60).experiments)
    return rise_of_criterion(records, left, target, columns, free=free)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_what_can_do_the_same_costs_nothing(scale):
    left, target = scale * BASIS[:, 3], scale * 5.0 * BASIS[:, 0]
    assert rise(left, target, 2.0 * BASIS[:, :1]) == pytest.approx(0.0, abs=1e-9)
    assert rise(left, target, target[:, None], free=False) == pytest.approx(0.0, abs=1e-9)


def test_what_can_do_a_part_leaves_the_rest_beside_the_noise():
    left, target = BASIS[:, 3], 3.0 * BASIS[:, 0] + 4.0 * BASIS[:, 1]
    assert rise(left, target, BASIS[:, :1]) == pytest.approx(60 * np.log(1.0 + 16.0))


def test_what_explains_what_the_effect_leaves_may_be_better_than_it():
    left, target = 2.0 * BASIS[:, 1], 3.0 * BASIS[:, 0]
    both = np.column_stack([BASIS[:, 0], BASIS[:, 1] + 0.5 * BASIS[:, 2]])
    assert rise(left, target, both) == pytest.approx(60 * np.log(0.2))
