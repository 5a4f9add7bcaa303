"""Names of effects: physics where the units say so, mathematics elsewhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.named_effects import described, seen

from workers.effects.forms import FORMS, EffectForm, FormCoefficient

UP = np.linspace(0.3, 2.1, 50)
BOTH = np.linspace(-2.0, 2.0, 50)


def name(units, site, form, *variables, **known) -> str:
    return described(site, form, *variables, units=units, **known).words


AT_ITSELF = [
    ("m/s", "viscous", "viscous friction"),
    ("rad/s", "viscous", "viscous friction"),
    ("rpm", "viscous", "viscous friction"),
    ("m/s", "quadratic", "drag"),
    ("m/s", "power", "drag that goes with a power of the speed"),
    ("degC", "power", "heat loss by a power law (as of natural convection)"),
    ("bar", "power", "outflow by a power law (as through an orifice or over a weir)"),
    ("V", "power", "a power law in z"),
    ("m/s", "coulomb", "Coulomb friction"),
    ("rad/s", "stribeck", "Stribeck friction"),
    ("m/s", "dahl", "friction with presliding (Dahl)"),
    ("Pa", "viscous", "leakage"),
    ("m3", "viscous", "leakage"),
    ("bar", "square_root", "flow through an orifice"),
    ("A.h", "viscous", "leakage of charge"),
    ("degC", "viscous", "heat loss"),
    ("A", "viscous", "electrical resistance"),
    ("g/l", "saturating", "saturation (as of Michaelis and Menten)"),
    ("mol/l", "viscous", "first-order loss (leakage or decay)"),
    ("m/s", "square_root", "a term in the square root of z"),
    ("K", "coulomb", "a term that switches with the sign of z"),
    *((unit, "viscous", "a term linear in z") for unit in ("V", "m", "1/s", "1", "")),
    ("%", "quadratic", "a term quadratic in z that has its sign"),
    ("foo^-3", "coulomb", "a term that switches with the sign of z"),
]


@pytest.mark.parametrize(("unit", "form", "words"), AT_ITSELF)
def test_a_law_of_a_state_at_its_own_rate(unit, form, words):
    assert name({"z": unit}, "der(z)", form, "z") == words


LAWS = {
    ("der(z)", "square"): "a term quadratic in z",
    ("der(z)", "cubic"): "a term cubic in z",
    ("der(z)", "exponential"): "a term exponential in z",
    ("der(z)", "contact"): "a power law in z above a threshold",
    ("der(z)", "stribeck"): "a term that switches with the sign of z, with a peak near zero",
    ("der(z)", "asymmetric_coulomb"): (
        "a term that switches with the sign of z between two levels"
    ),
    ("der(z)", "dahl"): "a hysteresis over z",
    ("der(z)", "signed_root"): "a term in the square root of z that has its sign",
    ("der(z)", "hinge"): "a term linear in z above a threshold",
    ("der(z)", "hinge_below"): "a term linear in z below a threshold",
    ("der(z)", "gap"): "a term linear in z beyond a gap",
    ("der(z)", "saturating"): "a term that saturates in z",
    ("der(z)", "periodic"): "a term periodic in z",
    ("der(z)", "periodic_travel"): "a term periodic in the integral of z",
    ("der(z)", "lagged"): "a term in the lagged z",
    ("der(z)", "table"): "a free curve of z",
    ("der(z)", "constant"): "a constant term",
    ("der(z)", "drift"): "a drift in time",
    ("der(z)", "sine"): "a sinusoid in time",
    ("pair a,b", "joint"): "a term linear in (a - b) up to a limit",
    ("pair a,b", "power"): "a power law in (a - b)",
    ("pair a,b", "leak"): "a term in the square root of (a - b) that has its sign",
    ("input F", "coulomb"): "a term that switches with the sign of z",
    ("input F", "dead_zone"): "a dead zone",
    ("input F", "power_characteristic"): "a power law",
    ("output y", "bias"): "an offset",
    ("output y", "hum"): "a sinusoid in time",
    ("parameter p", "linear"): "a variation linear in z",
    ("parameter p", "inverse"): "a variation inverse in z",
    ("parameter p", "inverse_square"): "a variation inverse in the square of z",
    ("parameter p", "exponential"): "a variation exponential in z",
    ("parameter p", "saturating"): "a variation that saturates in z",
    ("parameter p", "hill"): "a variation that saturates in the square of z",
    ("parameter p", "heating"): "a variation in the lagged square of z",
}


def variables_at(site: str, form: str) -> tuple[str, ...]:
    kind = {"der": "derivative"}.get(site[:3], site.partition(" ")[0])
    own = ("a - b",) if kind == "pair" else ("z",)
    return (*own, "w")[: FORMS[kind, form].variables]


@pytest.mark.parametrize(("site", "form"), LAWS)
def test_without_units_mathematics_reads_the_law_from_the_equation(site, form):
    assert name({}, site, form, *variables_at(site, form)) == LAWS[site, form]


@pytest.mark.parametrize(("kind", "form"), FORMS)
def test_every_form_has_a_name(kind, form):
    site = {"derivative": "der(z)", "pair": "pair a,b"}.get(kind, f"{kind} p")
    said = name({}, site, form, *variables_at(site, form))
    assert said
    assert "{" not in said


@pytest.mark.parametrize(
    ("equation", "words"),
    [
        ("k * (v^4 - at^4)", "a term of the fourth power of z"),
        ("k * v / (at + v + v^2 / L)", "a term that falls at high z"),
        ("k / (1 + v / at)", "a term that falls at high z"),
        ("k * v / (at + v)", "a term that saturates in z"),
        ("-k * sign(v)", "a term that switches with the sign of z"),
        ("k * abs(v)", "a term proportional to the magnitude of z"),
        ("k * v * abs(v) + k * v", "a term in z"),
        ("k * exp(v / at)", "a term exponential in z"),
        ("-k * (exp(abs(v) / at) - 1) * tanh(v / L)", "a term in z"),
    ],
)
def test_equations_that_the_library_may_have_one_day(equation, words):
    names = [n for n in ("k", "at", "L") if n in equation]
    coefficients = tuple(FormCoefficient(n, None) for n in names)
    form = EffectForm("new", "new", ("derivative",), equation, coefficients, 1)
    assert name({}, "der(z)", form, "z") == words


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
        (SPEED, "der(v)", "square v", LESS | FALLS, "drag"),
        (SPEED, "der(v)", "square v", RISES, "a term quadratic in v"),
        (SPEED, "der(v)", "square v", HILL, "a term quadratic in v"),
        (SPEED, "der(v)", "square v", LESS, "a term quadratic in v"),
    ],
    "friction whose level depends on something names that": [
        (PRESSED, "der(v)", "load_dependent_coulomb v p", AGAINST,
         "Coulomb friction proportional to the magnitude of p"),
        (PRESSED, "der(v)", "coulomb_table v p", AGAINST, "Coulomb friction that depends on p"),
        (PRESSED, "der(v)", "coulomb_table v p", PARTLY,
         "a term that switches with the sign of v, by a free curve of p"),
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
        (WARM, "der(T)", "power T-Ta", {}, "heat loss by a power law (as of natural convection)"),
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
        ({"T": "K", "m": "kg/s"}, "der(T)", "product m T", {},
         "convection (heat that a flow carries)"),
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
        ({"c": "mol/l"}, "der(c)", "square c", FALLS, "second-order loss (as of a reaction)"),
        ({"p": "bar"}, "der(p)", "hinge p", SPILLS,
         "outflow above a threshold (as of a relief valve)"),
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
