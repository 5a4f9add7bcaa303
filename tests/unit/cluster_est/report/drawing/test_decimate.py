"""Curves with fewer points keep every peak of every column."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cluster_est.report.drawing.decimate import column_of, extremes

NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))
CURVES = st.integers(1, 400).flatmap(
    lambda size: st.tuples(
        arrays(np.float64, size, elements=st.floats(0.0, 1e4)),
        arrays(np.float64, size, elements=NUMBERS),
    )
)


@given(CURVES, st.integers(4, 40))
def test_the_extremes_of_each_column_are_kept_and_little_else(curve, columns):
    times, y = np.sort(curve[0]), curve[1]
    kept = extremes(times, y, columns)
    gaps = int((np.diff(np.isfinite(y)) != 0).sum())
    assert len(kept) <= 2 * columns + 2 + 2 * gaps
    assert np.all(np.diff(kept) > 0)
    assert (kept[0], kept[-1]) == (0, len(y) - 1)
    place = column_of(times, columns)
    for column in np.unique(place):
        whole, inside = y[place == column], y[kept[place[kept] == column]]
        if np.isfinite(whole).any():
            assert np.nanmin(inside) == np.nanmin(whole)
            assert np.nanmax(inside) == np.nanmax(whole)


def test_columns_are_as_wide_as_each_other_whatever_the_sampling():
    times = np.array([0.0, 0.1, 0.2, 0.3, 9.0, 10.0])
    assert column_of(times, 10).tolist() == [0, 0, 0, 0, 9, 9]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_single_sample_that_spikes_survives(sign):
    times = np.linspace(0.0, 20.0, 100_000)
    curve = np.sin(times)
    curve[54_321] = sign * 7.0
    kept = extremes(times, curve, 200)
    assert 54_321 in kept
    assert len(kept) <= 402


def test_a_gap_stays_a_gap():
    curve = np.ones(10_000)
    curve[4000:4010] = np.nan
    kept = extremes(np.arange(10_000.0), curve, 50)
    assert np.isnan(curve[kept]).any()
    assert {3999, 4000, 4009, 4010} <= set(kept.tolist())


def test_no_samples_have_no_points():
    assert len(extremes(np.zeros(0), np.zeros(0), 10)) == 0
