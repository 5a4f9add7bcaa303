import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st
from support.named_effects import described, estimate, seen, visited

from cluster_est.problem.dimensions import dimension_of
from workers.effects.expression import parse
from workers.effects.forms import FORMS
from workers.fmu.xml import UnitDefinition

UP = np.linspace(0.3, 2.1, 50)
BOTH = np.linspace(-2.0, 2.0, 50)


def name(units, site, form, *variables, **known) -> str:
    return described(site, form, *variables, units=units, **known).words


AT_ITSELF = [
    ("m/s", "viscous", "viscous friction"),
    ("rad/s", "viscous", "viscous friction"),
    ("rpm", "viscous", "viscous friction"),
    ("m/s", "quadratic", "quadratic drag"),
    ("m/s", "power", "drag proportional to a power of the speed"),
    ("degC", "power", "heat loss by a power law"),
    ("bar", "power", "outflow by a power law"),
    ("V", "power", "a power law in z"),
    ("m/s", "coulomb", "Coulomb friction"),
    ("rad/s", "stribeck", "Stribeck friction"),
    ("m/s", "dahl", "presliding friction (Dahl model)"),
    ("Pa", "viscous", "leakage"),
    ("m3", "viscous", "leakage"),
    ("bar", "square_root", "flow through an orifice"),
    ("A.h", "viscous", "charge leakage"),
    ("degC", "viscous", "heat loss"),
    ("A", "viscous", "electrical resistance"),
    ("g/l", "saturating", "saturation (Michaelis-Menten kinetics)"),
    ("mol/l", "viscous", "first-order loss (leakage or decay)"),
    ("m/s", "square_root", "a term in the square root of z"),
    ("K", "coulomb", "a term that switches with the sign of z"),
    *((unit, "viscous", "a term linear in z") for unit in ("V", "m", "1/s", "1", "")),
    ("%", "quadratic", "a term quadratic in z with the sign of z"),
    ("foo^-3", "coulomb", "a term that switches with the sign of z"),
]


@pytest.mark.parametrize(("unit", "form", "words"), AT_ITSELF)
def test_a_law_of_a_state_at_its_own_rate(unit, form, words):
    assert name({"z": unit}, "der(z)", form, "z") == words


def variables_at(site: str, form: str) -> tuple[str, ...]:
    kind = {"der": "derivative"}.get(site[:3], site.partition(" ")[0])
    own = ("a - b",) if kind == "pair" else ("z",)
    return (*own, "w")[: FORMS[kind, form].variables]


def test_without_units_a_form_has_the_words_of_its_law():
    for kind, form in FORMS:
        site = {"derivative": "der(z)", "pair": "pair a,b"}.get(kind, f"{kind} p")
        said = name({}, site, form, *variables_at(site, form))
        law = FORMS[kind, form].law.value.format(
            v="(a - b)" if kind == "pair" else "z", w="w", s="p"
        )
        assert said == (law.replace("a term", "a variation") if kind == "parameter" else law)


@pytest.mark.parametrize(
    ("site", "form", "words"),
    [
        ("pair a,b", "joint", "a term linear in (a - b) up to a limit"),
        ("der(z)", "sine", "a sinusoid in time"),
        ("parameter p", "hill", "a variation that saturates in the square of z"),
        ("input F", "product", "a product of F and z"),
        ("output y", "characteristic_13", "a curved characteristic"),
    ],
)
def test_the_words_of_a_law(site, form, words):
    assert name({}, site, form, *variables_at(site, form)) == words


RISES, FALLS = {"curve": seen(UP, UP**2)}, {"curve": seen(UP, -(UP**2))}
SPILLS = {"curve": seen(UP, -np.maximum(UP - 1.0, 0.0))}
BOWL, HILL = {"curve": seen(BOTH, BOTH**2)}, {"curve": seen(BOTH, -(BOTH**2)), "values": [-1.0]}
AGAINST, PARTLY = {"curve": seen(BOTH, -np.abs(BOTH))}, {"curve": seen(BOTH, BOTH)}
HELD, PUSHED = (
    {"curve": seen(BOTH, way * np.maximum(BOTH - 1.0, 0.0), "v")} for way in (-1.0, 1.0)
)
SPRING = {"curve": seen(BOTH, -BOTH, "v"), "values": [-1.0]}
RIPPLE = {"curve": seen(BOTH, np.sin(4.0 * BOTH), "v")}
SINKS = {"curve": seen(np.linspace(0.0, 2.0, 50), 1.0 - np.linspace(0.0, 0.5, 50))}
LESS = {"values": [-1.0]}

SPEED, PRESSED = {"v": "m/s"}, {"v": "m/s", "p": "bar"}
SHAFTS, WARM = {"a": "rad/s", "b": "rad/s"}, {"T": "degC", "Ta": "degC"}
PLACE, ANGLE, DRIVEN = {"x": "m", **SPEED}, {"x": "rad", "v": "rad/s"}, {"F": "N", **SPEED}
GROWTH = {"mu": "1/h", "S": "g/l"}

WHERE = {
    "what feeds energy in is no friction": [
        (SPEED, "der(v)", "viscous v", LESS, "a term linear in v"),
        ({"z": "Pa"}, "der(z)", "linear z", {}, "a term linear in z"),
    ],
    "a law of another speed is no friction": [
        ({"w": "m/s", **SPEED}, "der(v)", "linear w", LESS, "a term linear in w"),
    ],
    "a square is drag only where the speed keeps its sign and is slowed": [
        (SPEED, "der(v)", "square v", LESS | FALLS, "quadratic drag"),
        (SPEED, "der(v)", "square v", RISES, "a term quadratic in v"),
        (SPEED, "der(v)", "square v", HILL, "a term quadratic in v"),
        (SPEED, "der(v)", "square v", LESS, "a term quadratic in v"),
    ],
    "friction whose level depends on something names that": [
        (PRESSED, "der(v)", "load_dependent_coulomb v p", AGAINST,
         "Coulomb friction proportional to the magnitude of p"),
        (PRESSED, "der(v)", "coulomb_table v p", AGAINST, "Coulomb friction that depends on p"),
        (PRESSED, "der(v)", "coulomb_table v p", PARTLY,
         "a term that switches with the sign of v and whose magnitude is a free curve of p"),
        ({}, "der(v)", "load_dependent_coulomb v p", AGAINST,
         "a term that switches with the sign of v, proportional to the magnitude of p"),
    ],
    "between two states": [
        ({"a": "degC", "b": "degC"}, "pair a,b", "linear a-b", {}, "heat conduction or convection"),
        (SHAFTS, "pair a,b", "linear a-b", {}, "viscous friction"),
        (SHAFTS, "pair a,b", "linear", {}, "viscous friction"),
        ({"a": "m", "b": "m", "area": "m2"}, "pair a,b", "leak a-b", {},
         "flow through an orifice"),
        ({"a": "rad/s", "b": "m/s"}, "pair a,b", "linear a-b", {}, "a term linear in (a - b)"),
    ],
    "over to what is around a state": [
        (WARM, "der(T)", "radiation T Ta", {}, "thermal radiation"),
        (WARM, "der(T)", "power T-Ta", {}, "heat loss by a power law"),
        (WARM, "der(T)", "linear T-Ta", LESS, "heat loss"),
        (WARM, "der(T)", "linear Ta", LESS, "a term linear in Ta"),
    ],
    "a length is a level only where nothing moves": [
        ({"h": "m", "area": "m2"}, "der(h)", "viscous h", {}, "leakage"),
        ({"h": "m", "area": "m2", **SPEED}, "der(h)", "viscous h", {}, "a term linear in h"),
    ],
    "a position needs to be the integral of what is changed": [
        (PLACE, "der(v)", "linear x", SPRING, "stiffness (a spring)"),
        (PLACE, "der(v)", "linear x", {"curve": seen(BOTH, -BOTH, "v2")}, "a term linear in x"),
        (PLACE, "der(v)", "hinge x", HELD, "end stop"),
        (PLACE, "der(v)", "hinge x", PUSHED, "a term linear in x above a threshold"),
        (ANGLE, "der(v)", "periodic x", RIPPLE, "cogging or eccentricity"),
    ],
    "a force at an input needs to know how it pushes": [
        (DRIVEN, "input F", "coulomb v", {}, "Coulomb friction"),
        (DRIVEN, "input F", "coulomb v", {"values": [-1.0, 1.0], "way": -1}, "Coulomb friction"),
        (DRIVEN, "input F", "coulomb v", {"way": 0}, "a term that switches with the sign of v"),
        ({"F": "N.m", **SPEED}, "input F", "viscous v", {}, "a term linear in v"),
    ],
    "heat that comes from elsewhere": [
        ({"T": "K", "i": "A"}, "der(T)", "square i", RISES, "Joule heating"),
        ({"T": "K", "i": "A"}, "der(T)", "square i", BOWL, "a term quadratic in i"),
        ({"T": "K", "P": "W"}, "der(T)", "linear P", {}, "heating"),
        ({"T": "K", "m": "kg/s"}, "der(T)", "product m T", LESS,
         "convection (heat transport by a flow)"),
        ({"T": "K", "m": "kg/s"}, "der(T)", "product m T", {}, "a product of m and T"),
        ({"Ti": "K", "T": "K", "m": "kg/s"}, "der(T)", "product m Ti", {},
         "convection (heat transport by a flow)"),
        ({"Ti": "K", "T": "K", "m": "kg/s"}, "der(T)", "product m Ti", LESS,
         "a product of m and Ti"),
    ],
    "signals have names without units": [
        ({"u": ""}, "input u", "dead_zone", {}, "a dead zone"),
        ({"y": "foo"}, "output y", "bias", {}, "an offset"),
    ],
    "a parameter that falls with a concentration is inhibited": [
        (GROWTH, "parameter mu", "saturating S", SINKS, "inhibition"),
        (GROWTH, "parameter mu", "saturating S", {}, "a variation that saturates in S"),
    ],
    "a resistance that follows the squared current warms up": [
        ({"R": "Ohm", "i": "A"}, "parameter R", "heating i", {}, "self-heating by the current"),
        ({"R": "Ohm", "w": "rad/s"}, "parameter R", "heating w", {},
         "a variation in the lagged square of w"),
    ],
    "reactions and valves": [
        ({"c": "mol/l"}, "der(c)", "square c", FALLS, "second-order loss (as in a reaction)"),
        ({"p": "bar"}, "der(p)", "hinge p", SPILLS,
         "outflow above a threshold (as through a relief valve)"),
        ({"V": "m3"}, "der(V)", "hinge V", SPILLS, "overflow"),
    ],
    "units of a signal are those of a config": [
        ({"T": "degC"}, "der(T)", "linear sun", {"given": {"sun": "W/m2"}}, "heating"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("units", "site", "text", "known", "words"),
    [pytest.param(*case, id=rule) for rule, cases in WHERE.items() for case in cases],
)
def test_a_name_of_physics_needs_all_that_makes_it_true(units, site, text, known, words):
    form, *variables = text.split()
    assert name(units, site, form, *(v.replace("-", " - ") for v in variables), **known) == words


SIZES = {
    "m/s": ("km/h", "mm/s", "mph", "cm/min"),
    "rad/s": ("deg/s", "rpm", "rev/min", "mrad/s"),
    "Pa": ("bar", "MPa", "psi", "mbar"),
    "K": ("mK",),
    "m3": ("l", "cm3", "ml"),
    "mol/l": ("mmol/l", "mol/m3", "kmol/m3"),
    "A": ("mA", "kA"),
}


@given(
    st.sampled_from([(unit, other) for unit, others in SIZES.items() for other in others]),
    st.sampled_from([f for f in FORMS if f[0] == "derivative" and FORMS[f].variables == 1]),
    st.sampled_from([-1.0, 1.0]),
)
def test_the_size_of_a_unit_changes_no_word(units, form, sign):
    values = [sign] * len(FORMS[form].coefficients)
    one, other = (name({"z": unit}, "der(z)", form[1], "z", values=values) for unit in units)
    assert one == other


K = -0.352


def square(x):
    return K * x**2


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
        "(0.48 to 0.52) and width = 0.001 m/s (fixed); in the data, v is between -0.6 and 0.6 m/s."
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
    assert f"with a period of {text} and the same phase in all experiments" in found.evidence[0]


def test_a_free_curve_lists_no_values():
    assert "with k1" not in described("der(v)", "table", "v").sentence


def test_a_free_filter_says_when_its_step_response_is_done():
    values = {"k1": 2.0, "k2": 0.0, "k3": 0.0, "tau": 40.0, "begin": 1.0}
    numbers = [estimate(name, value) for name, value in values.items()]
    said = described("der(v)", "hidden_dynamics", "F", estimates=numbers).sentence
    assert said.startswith(
        "Hidden dynamics from F at der(v): der(v) += k1 * z1 + k2 * z2 + k3 * z3"
    )
    assert said.endswith(
        "; no known form: the step response reaches 63 % after 40 s; a model with the time "
        "constant 40 s has nearly the same response."
    )
    untold = described("der(v)", "hidden_dynamics", "F").sentence
    assert "no known form" in untold


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
    assert said.endswith(f"; the estimate of UA is its value at {where} kg/s.")


@pytest.mark.parametrize(
    "form", [f for (kind, _), f in FORMS.items() if kind == "parameter"], ids=lambda f: f.name
)
def test_each_form_with_a_reference_says_where_a_parameter_has_its_estimate(form):
    """At the reference, the form leaves the parameter unchanged."""
    numbers = [estimate(c.name, 4.0 if c.name == "high" else 2.0) for c in form.coefficients]
    said = described("parameter p", form, "m", estimates=numbers).sentence
    referred = {c.name for c in form.coefficients} & {"at", "low"}
    place = said.partition("the estimate of p is its value at ")[2]
    assert bool(place) is bool(referred)
    if form.free:
        assert place == "m = 3."
    elif referred and not form.states:
        v, at = {"m": (2.0, 2.0), "t": (2.0, 2.0), "abs(m)": (-2.0, 2.0), "m^2": (-2.0, 4.0)}[
            place.partition(" = ")[0]
        ]
        symbols = {n: sp.Symbol(n) for n in ("s", "v", "t", *(c.name for c in form.coefficients))}
        known = dict.fromkeys(symbols, 0.7) | {"s": 5.0, "v": v, "t": v, "at": at}
        term = parse(form.equation, symbols, "")
        assert float(term.subs({symbols[n]: x for n, x in known.items()})) == pytest.approx(5.0)


def test_what_has_no_such_place_says_none():
    numbers = [estimate("k", 0.6), estimate("at", 0.12, "m")]
    assert "the estimate of" not in described("der(v)", "hinge", "x", estimates=numbers).sentence


def test_the_square_of_a_difference_is_in_brackets():
    numbers = [estimate("at", 5.684e4, "K2", on="known")]
    said = described("parameter C", "square", "a - b", estimates=numbers).sentence
    assert said.endswith("; the estimate of C is its value at (a - b)^2 = 5.684e+04 K2.")


def passing(site, form, low, high, *variables, coefficient, units=None):
    """An effect with a threshold of 4 V, and the range of its argument in the data."""
    variable = variables[0] if variables else site.partition(" ")[2]
    x = np.linspace(low, high, 99)
    curve = replace(seen(x, -np.sign(x) * np.maximum(np.abs(x) - 4.0, 0.0)), variable=variable)
    curve = replace(curve, variable_unit="V")
    numbers = [estimate(coefficient, 4.0, "V", error=0.01)]
    return described(site, form, *variables, estimates=numbers, curve=curve, units=units)


@pytest.mark.parametrize(
    ("low", "high", "words", "missed"),
    [
        (0.07, 4.462, "an upper limit", "u = -4 V"),
        (-2.5, 6.0, "an upper limit", "u = -4 V"),
        (-6.0, 2.5, "a lower limit", "u = 4 V"),
        (-4.1, 4.462, "saturation on both sides", ""),
    ],
)
def test_a_saturation_has_the_sides_that_the_data_show(low, high, words, missed):
    found = passing("input u", "saturation", low, high, coefficient="limit")
    assert found.words == words
    said = f"; the data do not reach {missed}, so they do not show what happens there."
    assert found.sentence.endswith(said if missed else " V.")


@pytest.mark.parametrize(
    ("site", "form", "variables", "coefficient", "low", "words", "told"),
    [
        ("der(v)", "gap", ("x",), "at", -2.0, "a term linear in x above a threshold", "x = -4 V"),
        ("der(v)", "gap", ("x",), "at", -9.0, "a term linear in x beyond a gap", ""),
        ("output y", "dead_zone", (), "k", -2.0, "a dead zone", "y = -4 V"),
        ("output y", "dead_zone", (), "k", -9.0, "a dead zone", ""),
        ("pair a,b", "joint", ("a - b",), "at", -2.0, "up to a limit", "a - b = -4 V"),
        ("der(v)", "hinge", ("x",), "at", 5.0, "above a threshold that the data do not pass",
         "the data do not pass x = 4 V, so they do not show that there is such a threshold"),
        ("der(v)", "hinge", ("x",), "at", -9.0, "a term linear in x above a threshold", ""),
        ("der(v)", "contact", ("x",), "at", 5.0, "that the data do not pass", "x = 4 V"),
        ("output y", "clip_above", (), "limit", -9.0, "an upper limit", ""),
    ],
)  # fmt: skip
def test_a_threshold_is_named_only_if_the_data_pass_it(
    site, form, variables, coefficient, low, words, told
):
    found = passing(site, form, low, 9.0, *variables, coefficient=coefficient)
    assert found.words.endswith(words)
    assert told in found.sentence
    assert ("the data do not" in found.sentence.partition(";")[2]) is bool(told)


@pytest.mark.parametrize(
    ("low", "words"),
    [(-9.0, "end stops on both sides (play between them)"), (-2.0, "end stop")],
)
def test_end_stops_are_those_that_the_data_reach(low, words):
    units = {"v": "m/s", "x": "m"}
    x = np.linspace(low, 9.0, 99)
    curve = seen(x, -np.sign(x) * np.maximum(np.abs(x) - 4.0, 0.0), integral_of="v")
    found = described(
        "der(v)", "gap", "x", estimates=[estimate("at", 4.0, "m")], curve=curve, units=units
    )
    assert found.words == words


def test_a_periodic_error_says_after_which_distance_it_repeats():
    numbers = [estimate("a", 0.3, "degC"), estimate("b", 0.1, "degC"), estimate("n", 2.0 * np.pi)]
    curve = replace(seen(np.linspace(0.0, 9.0, 5), np.ones(5)), variable="y", variable_unit="degC")
    said = described("output y", "periodic", "y", estimates=numbers, curve=curve).sentence
    assert ", a period of 1 degC; without the effect, y is between 0 and 9 degC." in said


@pytest.mark.parametrize(
    ("error", "text"), [(0.3, "1350.42 W (1349.82 to 1351.02)"), (30.0, "1350 W (1290 to 1410)")]
)
def test_the_digits_of_a_value_follow_from_its_interval(error, text):
    numbers = [estimate("k", 1350.42, "W", error=error)]
    assert text in described("der(v)", "square", "v", estimates=numbers).sentence


def powered(unit: str, n: float, error: float, *, level: bool = False) -> str:
    """The name of a power law with this exponent, of a state or of its difference from z."""
    units = {"x": unit, "z": unit} | ({"area": "m2"} if level else {})
    numbers = [estimate("k", 1.0), estimate("n", n, error=error), estimate("ref", 1.0, on="known")]
    argument = "x - z" if unit == "degC" else "x"
    return described("der(x)", "power", argument, estimates=numbers, units=units).words


@pytest.mark.parametrize(
    ("unit", "n", "error", "said"),
    [
        ("degC", 1.27, 0.01, "heat loss by a power law (as in natural convection)"),
        ("degC", 5.54, 0.04, "heat loss by a power law"),
        ("degC", 1.6, 0.2, "heat loss by a power law (as in natural convection)"),
        ("bar", 0.52, 0.02, "outflow by a power law (as through an orifice)"),
        ("bar", 1.5, 0.02, "outflow by a power law"),
        ("m", 1.49, 0.02, "outflow by a power law (as over a weir)"),
        ("m", 1.0, 0.3, "outflow by a power law (as through an orifice or over a weir)"),
        ("m/s", 1.7, 0.02, "drag proportional to a power of the speed"),
        ("m/s", 0.3, 0.02, "friction proportional to a power of the speed"),
    ],
)
def test_a_law_with_a_free_exponent_has_a_name_of_physics_only_with_the_exponent_of_physics(
    unit, n, error, said
):
    assert powered(unit, n, error, level=unit == "m") == said


def test_the_temperature_alone_drives_no_natural_convection():
    numbers = [estimate("k", 1.0), estimate("n", 1.3), estimate("ref", 1.0, on="known")]
    said = described("der(T)", "power", "T", estimates=numbers, units={"T": "degC"}).words
    assert said == "heat loss by a power law"


def test_a_square_of_a_speed_that_keeps_its_sign_is_a_drag():
    effect = described(
        "der(v)", "square", "v", values=[K], curve=visited(0.3, 2.1, square), declared=True
    )
    assert effect.words == "quadratic drag"


@pytest.mark.parametrize(("low", "high"), [(0.3, 2.1), (-2.1, -0.3)])
def test_a_convention_for_a_sign_that_never_occurs_is_no_other_equation(low, high):
    """Below zero v^2 and v|v| differ, but no measurement there is proposed."""
    assert not also("square", visited(low, high, square))
    assert not any("abs" in text for text in also("linear", visited(low, high, linear)))


@pytest.mark.parametrize("middle", [10.0, 100.0])
def test_a_measurement_is_proposed_near_the_data(middle):
    low, high = 0.98 * middle, 1.02 * middle
    found = also("linear", visited(low, high, linear, error=0.03))
    assert len(found) == 3
    assert all(0.4 * middle < each.told_at < 1.6 * middle for each in found.values())


def test_what_agrees_nearly_is_said_with_what_it_is_off():
    found = described(
        "der(v)", "linear", "v", values=[K], curve=visited(9.8, 10.2, linear, 0.03), declared=True
    )
    other = found.also[-1]
    assert other.share > 1e-3
    assert f"Over that range, it differs by at most {other.difference:.2g} m/s2 (" in found.sentence
    assert f"from {other.equation}" in found.sentence


def test_a_speed_that_takes_both_signs_tells_them_apart():
    assert not also("square", visited(-2.0, 2.1, square))


def test_a_switch_away_from_zero_is_a_constant():
    curve = visited(0.3, 2.1, lambda x: K * np.tanh(x / 0.02))
    found = also("coulomb", curve, -K, 0.02)
    assert found["-0.352"].told_at < 0.3


def test_a_narrow_range_leaves_the_exponent_open_if_the_effect_is_not_known_better():
    wide = also("linear", visited(9.8, 10.2, linear, error=0.03))
    assert len(wide) == 3  # the closest
    assert all(0.0 < each.share <= 0.1 for each in wide.values())
    assert not also("linear", visited(9.8, 10.2, linear, error=1e-5))


def test_only_bins_with_samples_count():
    """A gap in the data around zero, in which a square and a magnitude differ, tells nothing."""
    counts = np.zeros(48)
    counts[:3] = counts[-3:] = 1.0
    assert any("* abs(v)" in e for e in also("square", visited(-1.0, 1.0, square, 0.05, counts)))
    assert not also("square", visited(-1.0, 1.0, square, 0.05))


def test_nothing_is_said_of_what_is_no_curve():
    assert not also(
        "square", replace(visited(0.3, 2.1, square), why_not="the effect depends on the past")
    )


def test_an_undetermined_band_leaves_only_equations_that_are_the_same_there():
    plain = visited(0.3, 2.1, lambda x: K * np.tanh(x / 0.001))
    unknown = replace(plain, lower=plain.y * np.nan, upper=plain.y * np.nan)
    assert list(also("coulomb", unknown, -K, 0.001)) == ["-0.352"]


@given(st.floats(1e-3, 1e3), st.floats(1e-4, 1e4), st.sampled_from([1.0, -1.0]))
def test_units_of_variable_and_effect_change_no_finding(over, by, sign):
    def scaled(x):
        return sign * by * linear(x / over)

    plain = also("linear", visited(9.8, 10.2, linear, 0.03)).values()
    curve = visited(9.8 * over, 10.2 * over, scaled, 0.03)
    found = also("linear", curve, sign * by * K / over).values()
    for one, other in zip(plain, found, strict=True):
        assert other.told_at == pytest.approx(over * one.told_at)
        assert other.told_by == pytest.approx(by * one.told_by)


BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
POWERS = {
    ("m/s", "m.s-1", "km/h"): {"m": 1, "s": -1},
    ("m/s2", "m/s^2", "m/s²"): {"m": 1, "s": -2},
    ("rad/s", "deg/s", "rpm", "rev/min"): {"rad": 1, "s": -1},
    ("rad", "°"): {"rad": 1},
    ("K",): {"K": 1},
    ("W/m2",): {"kg": 1, "s": -3},
    ("W/(m2.K)",): {"kg": 1, "s": -3, "K": -1},
    ("N.m", "Nm"): {"kg": 1, "m": 2, "s": -2},
    ("Ohm",): {"kg": 1, "m": 2, "s": -3, "A": -2},
    ("l/min",): {"m": 3, "s": -1},
    ("V^0.5/s",): {"kg": 0.5, "m": 1, "s": -2.5, "A": -0.5},
    ("mmol/l",): {"mol": 1, "m": -3},
    ("Ah",): {"A": 1, "s": 1},
    ("1", "%"): {},
}
NONSENSE = (
    "", " ", "-", "foo^-3", "pu", "p.u.", "pH", "C", "F", "u", "e", "pi", "10 m", "2", "((((", "m/",
    "import os", "__class__", "s**9**9**9", "m999999999", "m" * 200, "nan", "dB", "furlong?",
)  # fmt: skip


def powers(**known: float) -> tuple[float, ...]:
    return tuple(float(known.get(base, 0.0)) for base in BASES)


def defined(offset: float = 0.0, **known: int) -> UnitDefinition:
    return UnitDefinition(tuple(known.get(base, 0) for base in BASES), offset)


@pytest.mark.parametrize("texts", POWERS, ids=" or ".join)
def test_units_of_many_shapes(texts):
    for text in texts:
        found = dimension_of(text, {})
        assert found is not None, text
        assert (found.powers, found.absolute) == (powers(**POWERS[texts]), True), text


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


@pytest.mark.parametrize(
    ("site", "form", "words"),
    [
        ("der(v)", "periodic", "a term in z that shows only one period in the data"),
        (
            "der(v)",
            "periodic_travel",
            "a term in the integral of z that shows only one period in the data",
        ),
        ("output y", "periodic", "a part that varies over y and shows only one period in the data"),
    ],
)
def test_a_wave_as_long_as_it_may_be_is_no_wave(site, form, words):
    variables = () if site.startswith("output") else ("z",)
    at_lowest = described(site, form, *variables, values=[1.0, 1.0, 0.0])
    assert at_lowest.words == words
    repeats = described(site, form, *variables, values=[1.0, 1.0, 1e-3])
    assert "periodic" in repeats.words


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (14.0, "tau = 14 s (10 to 18)"),
        (1800.0, "tau = 30 min (29.9 min to 30.1 min)"),
        (4.3e5, "tau = 4.98 d (4.98 d to 4.98 d)"),
    ],
)
def test_long_times_are_said_in_minutes_hours_and_days(seconds, said):
    numbers = [estimate("tau", seconds, "s", error=2.0)]
    assert said in described("input F", "lag", estimates=numbers).sentence


@pytest.mark.parametrize(
    ("unit", "values", "feeds"),
    [("m/s", [-1.0], True), ("m/s", [1.0], False), ("rad/s", [-1.0], True), ("V", [-1.0], False)],
)
def test_what_pushes_along_the_motion_is_said_to_feed_energy_in(unit, values, feeds):
    effect = described("der(v)", "viscous", "v", values=values, units={"v": unit})
    assert any("adds energy" in sentence for sentence in effect.evidence) is feeds
