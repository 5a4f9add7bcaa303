"""Curves with fewer points keep every peak."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cluster_est.report.decimate import peaks

NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))
CURVES = st.integers(1, 400).flatmap(
    lambda size: st.lists(arrays(np.float64, size, elements=NUMBERS), min_size=1, max_size=4)
)


@given(CURVES, st.integers(8, 60))
def test_the_extremes_of_each_stretch_are_kept(curves, most):
    kept = peaks(curves, most)
    size = len(curves[0])
    assert np.all(np.diff(kept) > 0)
    assert kept[0] == 0
    assert kept[-1] == size - 1
    if size <= most:
        assert kept.tolist() == list(range(size))
        return
    buckets = max(1, most // (2 * len(curves)))
    edges = np.unique(np.linspace(0, size, buckets + 1).astype(int))
    for curve in curves:
        for begin, end in pairwise(edges):
            whole = curve[begin:end]
            inside = curve[kept[(kept >= begin) & (kept < end)]]
            if np.isfinite(whole).any():
                assert np.nanmin(inside) == np.nanmin(whole)
                assert np.nanmax(inside) == np.nanmax(whole)


@given(CURVES, st.integers(8, 60))
def test_no_more_points_than_asked_for_but_for_ends_and_gaps(curves, most):
    kept = peaks(curves, most)
    gaps = sum(int((np.diff(np.isfinite(curve)) != 0).sum()) for curve in curves)
    assert len(kept) <= most + 2 * len(curves) + 2 + 2 * gaps


def test_a_single_sample_that_spikes_survives():
    curve = np.sin(np.linspace(0.0, 20.0, 100_000))
    curve[54_321] = 7.0
    kept = peaks([curve, np.zeros(100_000)], 400)
    assert 54_321 in kept
    assert len(kept) <= 402


def test_a_gap_stays_a_gap():
    curve = np.ones(10_000)
    curve[4000:4010] = np.nan
    kept = peaks([curve], 100)
    assert np.isnan(curve[kept]).any()
    assert {3999, 4000, 4009, 4010} <= set(kept.tolist())


def test_no_curves_have_no_points():
    assert len(peaks([], 10)) == 0
