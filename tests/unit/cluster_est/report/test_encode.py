"""What stands inside a page cannot leave its place and loses no digits that are seen."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.report.encode import doubles, floats, json_text, short


@given(st.text())
def test_no_text_ends_the_script_that_it_stands_in(text):
    found = json_text({text: [text]})
    assert not set("<>&\u2028\u2029") & set(found)
    assert json.loads(found) == {text: [text]}


def test_what_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="JSON"):
        json_text([float("nan")])


def test_a_small_movement_of_a_large_number_keeps_its_digits():
    values = 1e7 + 1e-3 * np.sin(np.linspace(0.0, 6.0, 1000))
    packed = floats(values)
    raw = np.frombuffer(base64.b64decode(packed["f4"]), "<f4")
    restored = raw.astype(float) + packed["offset"]
    assert np.abs(restored - values).max() < 1e-6 * np.ptp(values) + 2e-9


def test_times_are_exact():
    times = np.cumsum(np.full(1000, 0.1)) + 1e9
    assert np.array_equal(np.frombuffer(base64.b64decode(doubles(times)["f8"]), "<f8"), times)


def test_a_curve_without_samples_has_an_offset():
    packed = floats(np.full(3, np.nan))
    assert packed["offset"] == 0.0
    assert np.isnan(np.frombuffer(base64.b64decode(packed["f4"]), "<f4")).all()


def test_few_numbers_have_null_for_what_is_not_finite():
    assert short(np.array([1.0, np.nan, np.inf, 0.123456789])) == [1.0, None, None, 0.1234568]
