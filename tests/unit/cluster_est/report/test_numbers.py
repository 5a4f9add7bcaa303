"""Numbers as a person reads them."""

from __future__ import annotations

import math

import pytest

from cluster_est.report.numbers import beside, compact, count, digits, duration, interval, percent


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (None, "\u2013"),
        (math.nan, "\u2013"),
        (-math.inf, "\u2212\u221e"),
        (1234.56, "1235"),
        (-0.00123456, "\u22120.001235"),
        (1.5e-7, "1.500e\u22127"),
        (12345678.0, "1.235e7"),
        (0.99999, "1.0000"),
    ],
)
def test_four_digits(value, text):
    assert digits(value) == text


def test_an_estimate_has_two_digits_of_the_width_of_its_interval():
    assert beside(1.19972345, 0.0016) == "1.1997"
    assert beside(25.0, 100.0) == "25.00"
    assert interval(1.19891, 1.20053) == "1.1989 \u2026 1.2005"
    assert interval(math.nan, 1.0) == "\u2013"


def test_other_quantities():
    assert count(13553) == "13\u202f553"
    assert percent(0.123456) == "12.3\u2009%"
    assert [duration(s) for s in (2.5, 75.0, 7300.0)] == ["2.50 s", "1 min 15 s", "2 h 1 min"]
    assert [compact(v) for v in (0.001, 10.0, math.inf)] == ["0.001", "10", "\u221e"]
