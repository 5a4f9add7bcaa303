"""Conversions of units, against numbers from tables of physics."""

import pytest

from cluster_est.problem.tables.units import conversion, is_known, same_unit

FACTORS = {
    ("kg/min", "kg/s"): 1.0 / 60.0,
    ("g/s", "kg/s"): 1e-3,
    ("l/min", "m3/s"): 1e-3 / 60.0,
    ("m³/h", "l/s"): 1.0 / 3.6,
    ("km/h", "m/s"): 1.0 / 3.6,
    ("rpm", "rad/s"): 0.10471975511966,
    ("rev", "deg"): 360.0,
    ("mm/s^2", "m/s2"): 1e-3,
    ("J/(kg.K)", "kJ/kg/K"): 1e-3,
    ("W/m2/K", "W/(m2.K)"): 1.0,
    ("degC/min", "K/s"): 1.0 / 60.0,
    ("mbar", "Pa"): 100.0,
    ("Nm", "kN.m"): 1e-3,
    ("mAh", "C"): None,
    ("Ah", "A.s"): 3600.0,
    ("mmol/l", "mol/m3"): 1.0,
    ("kWh", "J"): 3.6e6,
    ("%", "1"): 0.01,
    ("cm2", "m2"): 1e-4,
    ("kg/min", "m3/s"): None,
    ("parsec", "m"): None,
    ("kg/", "kg"): None,
}


@pytest.mark.parametrize(("given", "wanted"), FACTORS)
def test_products_and_quotients_are_converted_by_their_parts(given, wanted):
    factor = FACTORS[given, wanted]
    found = conversion(given, wanted)
    if factor is None:
        assert found is None
    else:
        assert found is not None
        assert found.factor == pytest.approx(factor, rel=1e-9)
        assert found.offset == 0.0


@pytest.mark.parametrize(
    ("given", "wanted", "number", "expected"),
    [("°C", "K", 25.0, 298.15), ("degF", "degC", 212.0, 100.0), ("K", "degC", 0.0, -273.15)],
)
def test_temperatures_have_an_offset(given, wanted, number, expected):
    found = conversion(given, wanted)
    assert found is not None
    assert found.factor * number + found.offset == pytest.approx(expected)


def test_words_are_no_units():
    assert not any(is_known(word) for word in ("", "10", "flow", "kgs", "kg/x", "/s", "m/"))
    assert all(is_known(unit) for unit in ("1", "kg/min", "1/s", "W/(m2.K)", "km/h"))
    assert same_unit("m/s^2", "m/s²")
