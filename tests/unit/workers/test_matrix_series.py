"""Series of matrices that keep only what is not 0 throughout."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from workers.messages import MatrixSeries

MATRICES = arrays(float, (4, 2, 3), elements=st.sampled_from([0.0, 0.0, 0.0, 1.5, -2.0, np.inf]))


@given(MATRICES)
def test_nothing_is_lost(matrices):
    series = MatrixSeries.of(matrices)
    np.testing.assert_array_equal(np.asarray(series), matrices)
    np.testing.assert_array_equal(series.at(2), matrices[2])
    np.testing.assert_array_equal(series.row(1), matrices[:, 1])
    np.testing.assert_array_equal(series.largest(), np.abs(matrices).max(axis=0))
    assert series.values.shape[1] == (matrices != 0.0).any(axis=0).sum()


def test_what_is_no_number_is_kept():
    matrices = np.zeros((3, 2, 2))
    matrices[1, 0, 1] = np.nan
    assert np.isnan(MatrixSeries.of(matrices).values[1, 0])


def test_entries_that_are_not_kept_cannot_be_shared():
    with pytest.raises(ValueError, match="copied"):
        np.asarray(MatrixSeries.of(np.ones((2, 1, 1))), copy=False)
