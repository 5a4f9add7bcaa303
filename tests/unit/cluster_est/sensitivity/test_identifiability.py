"""The order of estimation of matrices whose dependencies are known."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.sensitivity.identifiability import identifiable_order

BASIS = np.linalg.qr(np.random.default_rng(2).normal(size=(40, 5)))[0]


def ordered(columns, changes=None, most=15.0):
    columns = np.column_stack(columns)
    changes = np.ones(columns.shape[1]) if changes is None else np.array(changes)
    return identifiable_order(columns, changes, most)


def test_independent_columns_are_ordered_by_size():
    found = ordered([BASIS[:, 0], 5.0 * BASIS[:, 1], 2.0 * BASIS[:, 2]])
    assert [each.unknown for each in found] == [1, 2, 0]
    assert [each.collinearity for each in found] == pytest.approx([1.0, 1.0, 1.0])
    assert all(each.together for each in found)
    assert found[0].size == pytest.approx(5.0 / np.sqrt(40))


def test_the_index_of_two_columns_is_that_of_their_angle():
    """Eigenvalues of N'N are 1 +- cos."""
    angle = 0.1
    second = np.cos(angle) * BASIS[:, 0] + np.sin(angle) * BASIS[:, 1]
    found = ordered([2.0 * BASIS[:, 0], second])
    assert found[1].collinearity == pytest.approx(1.0 / np.sqrt(1.0 - np.cos(angle)))
    assert found[1].together == (found[1].collinearity < 15.0)


def test_what_others_make_up_for_is_left_out_and_spoils_nothing_after_it():
    a, b, c = BASIS[:, 0], BASIS[:, 1], BASIS[:, 2]
    found = ordered([3.0 * a, 2.0 * b, a + b, 0.5 * c])
    assert [(each.unknown, each.together) for each in found] == [
        (0, True), (1, True), (3, True), (2, False)
    ]  # fmt: skip
    assert found[3].collinearity > 1e6


def test_what_the_data_do_not_see_is_last():
    found = ordered([np.zeros(40), BASIS[:, 0]])
    assert [each.unknown for each in found] == [1, 0]
    assert found[1].collinearity == np.inf
    assert not found[1].together


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_of_an_unknown_do_not_matter(scale):
    plain = ordered([BASIS[:, 0], 0.5 * BASIS[:, 1]])
    other = ordered([BASIS[:, 0] / scale, 0.5 * BASIS[:, 1]], [scale, 1.0])
    assert [e.unknown for e in plain] == [e.unknown for e in other]
    assert [e.size for e in plain] == pytest.approx([e.size for e in other])
