"""Texts of units as dimensions: many shapes, other sizes, and nonsense."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.closed_loop.findings.words.dimensions import BASES, NUMBER, dimension
from cluster_est.closed_loop.findings.words.known_units import dimension_of
from cluster_est.closed_loop.findings.words.unit_text import dimension_of_text
from workers.fmu.parsing.units import UnitDefinition

POWERS = {
    "m/s": {"length": 1, "time": -1},
    "m.s-1": {"length": 1, "time": -1},
    "km/h": {"length": 1, "time": -1},
    "m/s2": {"length": 1, "time": -2},
    "m/s^2": {"length": 1, "time": -2},
    "m/s²": {"length": 1, "time": -2},
    "rad/s": {"angle": 1, "time": -1},
    "deg/s": {"angle": 1, "time": -1},
    "rpm": {"angle": 1, "time": -1},
    "rev/min": {"angle": 1, "time": -1},
    "rad": {"angle": 1},
    "°": {"angle": 1},
    "K": {"temperature": 1},
    "W/m2": {"mass": 1, "time": -3},
    "W/(m2.K)": {"mass": 1, "time": -3, "temperature": -1},
    "N.m": {"mass": 1, "length": 2, "time": -2},
    "Nm": {"mass": 1, "length": 2, "time": -2},
    "Ohm": {"mass": 1, "length": 2, "time": -3, "current": -2},
    "l/min": {"length": 3, "time": -1},
    "V^0.5/s": {"mass": 0.5, "length": 1, "time": -2.5, "current": -0.5},
    "mmol/l": {"amount": 1, "length": -3},
    "Ah": {"current": 1, "time": 1},
}
NONSENSE = (
    "", " ", "-", "foo^-3", "pu", "p.u.", "pH", "C", "F", "u", "e", "pi", "10 m", "2", "((((", "m/",
    "import os", "__class__", "s**9**9**9", "m999999999", "m" * 200, "nan", "dB", "furlong?",
)  # fmt: skip


@pytest.mark.parametrize(("text", "powers"), POWERS.items())
def test_units_of_many_shapes(text, powers):
    assert dimension_of_text(text) == dimension(**powers)


@pytest.mark.parametrize("text", ["1", "%"])
def test_numbers_are_numbers(text):
    assert dimension_of_text(text) == NUMBER


@pytest.mark.parametrize("text", NONSENSE)
def test_what_is_no_unit_or_could_be_several_says_nothing(text):
    assert dimension_of_text(text) is None


@pytest.mark.parametrize("text", ["degC", "°C", "degF"])
def test_a_temperature_with_a_zero_of_its_own_is_not_absolute(text):
    found = dimension_of_text(text)
    assert found is not None
    assert found.same_as(dimension(temperature=1))
    assert not found.absolute


@given(st.text(max_size=40))
def test_any_text_is_read_or_says_nothing(text):
    found = dimension_of_text(text)
    assert found is None or len(found.powers) == len(BASES)


@given(st.sampled_from(["", "m", "k", "u", "M", "n"]), st.sampled_from(["m", "N", "Pa", "W", "A"]))
def test_a_prefix_changes_no_dimension(prefix, unit):
    assert dimension_of_text(prefix + unit) == dimension_of_text(unit)


def defined(**powers: int) -> UnitDefinition:
    bases = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
    return UnitDefinition(tuple(powers.get(base, 0) for base in bases))


def test_an_fmu_may_define_a_unit_that_nobody_else_knows():
    assert dimension_of("knots of mine", {"knots of mine": defined(m=1, s=-1)}) == dimension(
        length=1, time=-1
    )


def test_a_definition_may_leave_the_angle_out():
    assert dimension_of("rad/s", {"rad/s": defined(s=-1)}) == dimension(angle=1, time=-1)


def test_a_definition_that_contradicts_the_text_says_nothing():
    assert dimension_of("m/s", {"m/s": defined()}) is None


def test_a_definition_with_an_offset_is_not_absolute():
    celsius = UnitDefinition((0, 0, 0, 0, 1, 0, 0, 0), 273.15)
    found = dimension_of("grad C", {"grad C": celsius})
    assert found is not None
    assert not found.absolute
