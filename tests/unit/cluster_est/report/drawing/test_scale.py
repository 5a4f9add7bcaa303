"""Scales hold their values, and what is written beside them can be read."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.drawn import UNITS

from cluster_est.report.drawing import Scale

FINITE = st.floats(-1e9, 1e9)


@given(st.lists(FINITE, min_size=1, max_size=20))
def test_every_value_stands_inside(values):
    places = Scale.around(np.array(values)).places(np.array(values))
    assert np.all((places >= 0) & (places <= UNITS))


@given(FINITE, st.floats(1e-6, 1e9), st.integers(2, 10))
def test_written_values_are_few_evenly_spaced_and_different(low, span, count):
    scale = Scale(low, low + span)
    if not scale.high - scale.low > 1e-7 * abs(low):
        return
    found = scale.ticks(count)
    values = np.array([value for value, _ in found])
    assert 2 <= len(found) <= max(1.35 * count + 1, 5)  # a step finer, where there was but one
    assert np.all((values >= scale.low - 1e-6 * span) & (values <= scale.high + 1e-6 * span))
    if len(values) > 2:
        assert np.diff(values) == pytest.approx(np.diff(values)[0], rel=1e-3)
    assert len({text for _, text in found}) == len(found)


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 10.0, "0 2 4 6 8 10"),
        (-0.05, 0.05, "\u22120.04 \u22120.02 0 0.02 0.04"),
        (0.0, 3e6, "0 1e6 2e6 3e6"),
        (1e7, 1e7 + 4.0, "1.0000000e7 1.0000001e7 1.0000002e7 1.0000003e7 1.0000004e7"),
    ],
)
def test_they_are_round_and_have_the_digits_they_need(low, high, texts):
    assert [text for _, text in Scale(low, high).ticks(4)] == texts.split()


def test_a_scale_of_large_ratios_is_logarithmic_where_it_may_be():
    values = np.array([0.001, 50.0])
    scale = Scale.around(values, may_be_log=True)
    assert scale.log
    assert [text for _, text in scale.ticks(6)] == ["0.001", "0.01", "0.1", "1", "10"]
    middle = scale.places(np.sqrt(values[:1] * values[1:]))
    assert middle == pytest.approx([0.5 * UNITS])
    assert np.isnan(scale.places(np.array([-1.0, 0.0]))).all()
    assert not Scale.around(values).log
    assert not Scale.around(np.array([1.0, 9.0]), may_be_log=True).log


def test_values_that_are_equal_or_none_have_a_scale_too():
    for values in (np.full(3, 5.0), np.zeros(2), np.array([np.nan]), np.zeros(0)):
        scale = Scale.around(values)
        assert scale.high > scale.low


@pytest.mark.parametrize("low", [-1.31, -0.99, 0.02, 311.3])
@pytest.mark.parametrize("span", [1e-6, 0.7, 3.21, 4.1, 9.9])
def test_there_are_two_ticks_at_least_so_that_a_size_can_be_read(low, span):
    ticks = [value for value, _ in Scale(low, low + span).ticks(1)]
    assert 2 <= len(ticks) <= 12
    assert all(low <= value <= low + span for value in ticks)
