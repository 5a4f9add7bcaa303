"""Texts of units as dimensions: many shapes, other sizes, and nonsense."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.closed_loop.findings.words.known_units import dimension_of
from workers.fmu.parsing.units import UnitDefinition

BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
POWERS = {
    "m/s": {"m": 1, "s": -1},
    "m.s-1": {"m": 1, "s": -1},
    "km/h": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "m/s^2": {"m": 1, "s": -2},
    "m/s²": {"m": 1, "s": -2},
    "rad/s": {"rad": 1, "s": -1},
    "deg/s": {"rad": 1, "s": -1},
    "rpm": {"rad": 1, "s": -1},
    "rev/min": {"rad": 1, "s": -1},
    "rad": {"rad": 1},
    "°": {"rad": 1},
    "K": {"K": 1},
    "W/m2": {"kg": 1, "s": -3},
    "W/(m2.K)": {"kg": 1, "s": -3, "K": -1},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "Nm": {"kg": 1, "m": 2, "s": -2},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "l/min": {"m": 3, "s": -1},
    "V^0.5/s": {"kg": 0.5, "m": 1, "s": -2.5, "A": -0.5},
    "mmol/l": {"mol": 1, "m": -3},
    "Ah": {"A": 1, "s": 1},
    "1": {},
    "%": {},
}
NONSENSE = (
    "", " ", "-", "foo^-3", "pu", "p.u.", "pH", "C", "F", "u", "e", "pi", "10 m", "2", "((((", "m/",
    "import os", "__class__", "s**9**9**9", "m999999999", "m" * 200, "nan", "dB", "furlong?",
)  # fmt: skip


def powers(**known: float) -> tuple[float, ...]:
    return tuple(float(known.get(base, 0.0)) for base in BASES)


def defined(offset: float = 0.0, **known: int) -> UnitDefinition:
    return UnitDefinition(tuple(known.get(base, 0) for base in BASES), offset)


@pytest.mark.parametrize("text", POWERS)
def test_units_of_many_shapes(text):
    found = dimension_of(text, {})
    assert found is not None
    assert (found.powers, found.absolute) == (powers(**POWERS[text]), True)


@pytest.mark.parametrize("text", NONSENSE)
def test_what_is_no_unit_or_could_be_several_says_nothing(text):
    assert dimension_of(text, {}) is None


@pytest.mark.parametrize("text", ["degC", "°C", "degF"])
def test_a_temperature_with_a_zero_of_its_own_is_not_absolute(text):
    found = dimension_of(text, {})
    assert found is not None
    assert (found.powers, found.absolute) == (powers(K=1), False)


@given(st.text(max_size=40))
def test_any_text_is_read_or_says_nothing(text):
    found = dimension_of(text, {})
    assert found is None or len(found.powers) == len(BASES)


@given(st.sampled_from(["", "m", "k", "u", "M", "n"]), st.sampled_from(["m", "N", "Pa", "W", "A"]))
def test_a_prefix_changes_no_dimension(prefix, unit):
    assert dimension_of(prefix + unit, {}) == dimension_of(unit, {})


@pytest.mark.parametrize(
    ("unit", "definition", "known"),
    [
        pytest.param("knots of mine", defined(m=1, s=-1), {"m": 1, "s": -1}, id="of its own"),
        pytest.param("rad/s", defined(s=-1), {"rad": 1, "s": -1}, id="without the angle"),
        pytest.param("m/s", defined(), None, id="against the text"),
        pytest.param("grad C", defined(273.15, K=1), {"K": 1}, id="with an offset"),
    ],
)
def test_an_fmu_may_define_its_units(unit, definition, known):
    found = dimension_of(unit, {unit: definition})
    assert (found and found.powers) == (None if known is None else powers(**known))
    if found is not None:
        assert found.absolute is (definition.offset == 0.0)
