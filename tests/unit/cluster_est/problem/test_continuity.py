"""Differences of states between segments, as residuals."""

import numpy as np
import pytest

from cluster_est.problem.search_space.continuity import StateContinuity, StateEnd


def test_a_difference_counts_over_its_scale_and_by_its_weight():
    # the first segment ends at compared - sigma * residual = 5 - 2 * 1.5 = 2
    ends = (StateEnd(0, row=1, compared=5.0, sigma=2.0, unknown=3, scale=4.0),)
    continuity = StateContinuity(ends, weight=10.0)
    x = np.array([0.0, 0.0, 0.0, 2.5])
    sent = np.array([7.0, 1.5])
    np.testing.assert_allclose(continuity.applied(0, x, sent), [7.0, 10.0 * 0.5 / 4.0])
    np.testing.assert_array_equal(sent, [7.0, 1.5])
    np.testing.assert_allclose(continuity.differences([continuity.applied(0, x, sent)]), [0.5])
    np.testing.assert_allclose(continuity.scales, [4.0])


def test_segments_that_end_a_record_stay_as_they_are():
    continuity = StateContinuity((StateEnd(0, 0, 0.0, 1.0, 1, 1.0),))
    sent = np.array([1.0, 2.0])
    assert continuity.applied(1, np.zeros(2), sent) is sent
    assert continuity.acting(0) == [1]
    assert continuity.acting(1) == []


@pytest.mark.parametrize("weight", [0.5, 100.0])
def test_no_difference_is_no_residual_whatever_the_weight(weight):
    ends = tuple(StateEnd(0, j, 0.0, 1.0, j, 3.0) for j in range(2))
    continuity = StateContinuity(ends, weight)
    x = np.array([1.25, -0.5])
    np.testing.assert_array_equal(continuity.applied(0, x, -x), np.zeros(2))
