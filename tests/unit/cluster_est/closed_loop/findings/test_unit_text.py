import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.closed_loop.findings.unit_text import LONGEST_UNIT, powers, read_unit

FORCE, HEAT_TRANSFER = powers(mass=1, length=1, time=-2), powers(mass=1, time=-3, temperature=-1)
POWER = powers(mass=1, length=2, time=-3)
READ = {
    "m": powers(length=1),
    "mm": powers(length=1),
    "ms": powers(time=1),
    "min": powers(time=1),
    "meters": powers(length=1),
    "hours": powers(time=1),
    "mcd": powers(luminosity=1),
    "kWh": powers(mass=1, length=2, time=-2),
    "m/s2": powers(length=1, time=-2),
    "m/s^2": powers(length=1, time=-2),
    "m.s-2": powers(length=1, time=-2),
    "m\u00b7s\u207b\u00b2": powers(length=1, time=-2),
    "m/s/s": powers(length=1, time=-2),
    "m per s": powers(length=1, time=-1),
    "km/h": powers(length=1, time=-1),
    "1/s": powers(time=-1),
    "s-1": powers(time=-1),
    "N": FORCE,
    "kg m / s2": FORCE,
    "kg.m/s2": FORCE,
    "lbf": FORCE,
    "Nm": powers(mass=1, length=2, time=-2),
    "W/(m2.K)": HEAT_TRANSFER,
    "W/m2/K": HEAT_TRANSFER,
    "W/(m2.degC)": HEAT_TRANSFER,
    "J/s": POWER,
    "V.A": POWER,
    "(N)(m)/s": POWER,
    "rad/s": powers(angle=1, time=-1),
    "rpm": powers(angle=1, time=-1),
    "rev/min": powers(angle=1, time=-1),
    "Hz": powers(time=-1),
    "\u00b5m": powers(length=1),
    "k\u2126": powers(mass=1, length=2, time=-3, current=-2),
    "m**0.5": powers(length=0.5),
    "%": powers(),
    "1": powers(),
    "%/s": powers(time=-1),
}


@pytest.mark.parametrize("text", READ)
def test_a_unit_is_read_with_its_prefixes_products_and_powers(text):
    found = read_unit(text)
    assert found is not None
    assert found.powers == pytest.approx(READ[text])
    assert found.absolute


@pytest.mark.parametrize(
    ("text", "absolute"),
    [
        ("degC", False), ("\u00b0C", False), ("Celsius", False), ("degF", False), ("K", True),
        ("degR", True),
    ],
)  # fmt: skip
def test_the_zero_of_a_temperature_in_degrees_is_not_its_own(text, absolute):
    found = read_unit(text)
    assert found is not None
    assert (found.powers, found.absolute) == (powers(temperature=1), absolute)


@pytest.mark.parametrize(
    "text",
    [
        "", " ", "-", "pu", "C", "F", "pH", "foo", "m+s", "m-s", "2*m", "10 m", "m/", "/m", "m//s",
        "(m", "m)", "()", "m**", "m**s", "m1234", "m**-", "sqrt(m)", "m.", "m" * (LONGEST_UNIT + 1),
    ],
)  # fmt: skip
def test_what_is_no_unit_says_nothing(text):
    assert read_unit(text) is None


@given(st.text(alphabet="mskgNW1209()*/.^- %\u00b0\u00b2", max_size=LONGEST_UNIT))
def test_any_text_is_a_unit_or_none(text):
    found = read_unit(text)
    assert found is None or len(found.powers) == len(powers())
