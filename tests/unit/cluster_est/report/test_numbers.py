"""Numbers as a person reads them."""

from math import inf, nan

import pytest

from cluster_est.report.numbers import beside, compact, count, digits, duration, interval, percent


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (digits, 0.0, "0"),
        (digits, None, "\u2013"),
        (digits, nan, "\u2013"),
        (digits, -inf, "\u2212\u221e"),
        (digits, 1234.56, "1235"),
        (digits, -0.00123456, "\u22120.001235"),
        (digits, 1.5e-7, "1.500e\u22127"),
        (digits, 12345678.0, "1.235e7"),
        (digits, 0.99999, "1.0000"),
        (count, 13553, "13\u202f553"),
        (percent, 0.123456, "12.3\u2009%"),
        (duration, 2.5, "2.50 s"),
        (duration, 75.0, "1 min 15 s"),
        (duration, 7300.0, "2 h 1 min"),
        (compact, 0.001, "0.001"),
        (compact, 10.0, "10"),
        (compact, inf, "\u221e"),
    ],
)
def test_a_number_is_written_so(write, value, text):
    assert write(value) == text


def test_an_estimate_has_two_digits_of_the_width_of_its_interval():
    assert beside(1.19972345, 0.0016) == "1.1997"
    assert beside(25.0, 100.0) == "25.00"
    assert interval(1.19891, 1.20053) == "1.1989 \u2026 1.2005"
    assert interval(nan, 1.0) == "\u2013"
