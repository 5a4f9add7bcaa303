"""Findings as one would say them, with the equations that agree where the data were."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.named_effects import described, estimate, seen, visited

K = -0.352


def square(x):
    return K * x**2


def switch(x):
    return K * np.tanh(x / 0.02)


def linear(x):
    return K * x


def also(form, curve, *values, **known):
    """The equations that agree with an effect in v at der(v), by their text."""
    found = described(
        "der(v)", form, "v", values=values or (K,), curve=curve, declared=True, way=0, **known
    )
    return {each.equation: each for each in found.also}


def test_a_force_with_its_range():
    numbers = [estimate("k", 0.5, "m/s2"), estimate("width", 0.001, "m/s", on="known")]
    x = np.linspace(-0.6, 0.6, 5)
    curve = replace(seen(x, -x), variable="v", variable_unit="m/s")
    found = described("der(v)", "coulomb", "v", estimates=numbers, curve=curve)
    assert found.sentence == (
        "Coulomb friction at der(v): der(v) += -k * tanh(v / width), with k = 0.5 m/s2 "
        "(0.48 to 0.52); in the data v went from -0.6 to 0.6 m/s."
    )


def test_a_pair_and_a_value_that_is_not_determined():
    numbers = [estimate("k", 2.0, "?/s"), estimate("back", 1.0, "1", error=math.nan)]
    units = {"a": "degC", "b": "degC"}
    said = described("pair a,b", "linear", "a - b", estimates=numbers, units=units).sentence
    assert said.startswith("Heat conduction or convection between a and b: der(a) += ")
    assert said.endswith("with k = 2 (1.98 to 2.02) and back = 1 (not determined).")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0032, "0.0032 s"), (90.0, "90 s"), (300.0, "5 min"), (86_400.0, "24 h"), (6e5, "6.94 d")],
)
def test_a_wave_says_its_period_in_the_unit_that_reads_well(seconds, text):
    values = (1.0, 0.5, 2.0 * np.pi / seconds)
    found = described("der(v)", "sine", values=values, declared=True)
    assert found.period == pytest.approx(seconds)
    assert f", a period of {text}" in found.sentence
    assert f"with a period of {text}, with one phase in all experiments" in found.evidence[0]


def test_a_free_curve_lists_no_values():
    assert "with k1" not in described("der(v)", "table", "v").sentence


def test_a_coefficient_at_its_bound_is_not_said_to_be_undetermined():
    held = replace(estimate("k", 0.0, error=math.nan), at_bound="lower")
    said = described("der(v)", "square", "v", estimates=[held]).sentence
    assert "with k = 0 (at its lower bound)" in said


@pytest.mark.parametrize(
    ("form", "where"),
    [("power", "abs(m) = 0.12"), ("linear", "m = 0.12"), ("square", "m^2 = 0.12")],
)
def test_a_parameter_that_varies_is_the_one_at_a_place(form, where):
    numbers = [estimate("n", 0.6), estimate("at", 0.12, "kg/s", on="known")]
    said = described("parameter UA", form, "m", estimates=numbers).sentence
    assert said.endswith(f"; the value of UA is the one at {where} kg/s.")


def test_what_has_no_such_place_says_none():
    numbers = [estimate("k", 0.6), estimate("at", 0.12, "m")]
    assert "the one at" not in described("der(v)", "hinge", "x", estimates=numbers).sentence


def test_a_square_of_a_speed_that_keeps_its_sign_is_also_a_drag():
    effect = described(
        "der(v)", "square", "v", values=[K], curve=visited(0.3, 2.1, square), declared=True
    )
    (other,) = effect.also
    assert effect.words == other.words == "drag"
    assert other.equation == "-0.352 * v * abs(v)"
    assert other.share < 1e-12
    assert other.told_at < 0.0
    assert other.told_by == pytest.approx(-2.0 * K * other.told_at**2)
    assert effect.sentence.endswith(
        f"On that range it is also {other.equation} (drag): at v = {other.told_at:.3g} m/s the two "
        f"would differ by {other.told_by:.2g} m/s2, so measure there to tell them apart."
    )


def test_what_agrees_nearly_is_said_with_what_it_is_off():
    found = described(
        "der(v)", "linear", "v", values=[K], curve=visited(9.8, 10.2, linear, 0.03), declared=True
    )
    other = found.also[-1]
    assert other.share > 1e-3
    assert f"On that range it is, but for {other.difference:.2g} m/s2 (" in found.sentence
    assert f"also {other.equation}" in found.sentence


def test_a_speed_that_takes_both_signs_tells_them_apart():
    assert not also("square", visited(-2.0, 2.1, square))


def test_a_switch_away_from_zero_is_a_constant():
    found = also("coulomb", visited(0.3, 2.1, switch), -K, 0.02)
    assert found["-0.352"].told_at < 0.3


def test_what_cannot_be_negative_is_not_told_apart_there():
    """Over amounts v^2 and v|v| are one equation in two ways of writing."""
    curve = visited(0.3, 2.1, square)
    assert also("square", curve, units={"v": "m/s"})
    assert not also("square", curve, units={"v": "kg"})


def test_a_narrow_range_leaves_the_exponent_open_if_the_effect_is_not_known_better():
    wide = also("linear", visited(9.8, 10.2, linear, error=0.03))
    assert len(wide) == 3  # the closest
    assert all(0.0 < each.share <= 0.1 for each in wide.values())
    assert set(also("linear", visited(9.8, 10.2, linear, error=1e-5))) <= {"-0.352 * abs(v)"}


def test_only_bins_with_samples_count():
    """A gap in the data around zero, in which a square and a magnitude differ, tells nothing."""
    counts = np.zeros(48)
    counts[:3] = counts[-3:] = 1.0
    assert any("* abs(v)" in e for e in also("square", visited(-1.0, 1.0, square, 0.05, counts)))
    assert not also("square", visited(-1.0, 1.0, square, 0.05))


def test_nothing_is_said_of_what_is_no_curve():
    assert not also("square", replace(visited(0.3, 2.1, square), why_not="it depends on the past"))


def test_an_undetermined_band_leaves_only_equations_that_are_the_same_there():
    plain = visited(0.3, 2.1, square)
    unknown = replace(plain, lower=plain.y * np.nan, upper=plain.y * np.nan)
    assert list(also("square", unknown)) == ["-0.352 * v * abs(v)"]


@given(st.floats(1e-3, 1e3), st.floats(1e-4, 1e4), st.sampled_from([1.0, -1.0]))
def test_units_of_variable_and_effect_change_no_finding(over, by, sign):
    def scaled(x):
        return sign * by * square(x / over)

    (plain,) = also("square", visited(0.3, 2.1, square)).values()
    curve = visited(0.3 * over, 2.1 * over, scaled)
    ((text, other),) = also("square", curve, sign * by * K / over**2).items()
    assert text.endswith("* v * abs(v)")
    assert other.told_at == pytest.approx(over * plain.told_at)
    assert other.told_by == pytest.approx(by * plain.told_by)
