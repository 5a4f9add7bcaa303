"""Names of effects: physics where the units say so, mathematics elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.loop_objects import made_bench, made_problem

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.words.naming import Namer
from cluster_est.results.tables.row_types import EffectCurve
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.fmu.description import ModelDescription
from workers.messages import Effect

TEMPLATE = made_bench(made_problem(50)).description


def description(**units: str) -> ModelDescription:
    """A model whose variables have these units, and no definitions of them."""
    known = next(iter(TEMPLATE.variables.values()))
    variables = {name: replace(known, name=name, kind="real", unit=u) for name, u in units.items()}
    return replace(TEMPLATE, variables=variables, units={})


def candidate(site: EffectSite, form: str, *variables: str, way: int = 1) -> EffectCandidate:
    """An effect whose strengths are bounded to one side, as the search does where it knows that."""
    found = FORMS[site.kind, form]
    count = len(found.coefficients)
    free = (-np.inf,) * count, (np.inf,) * count
    low, high = {1: ((0.0,) * count, free[1]), -1: (free[0], (0.0,) * count), 0: free}[way]
    effect = Effect("e", str(site), form, variables)
    return EffectCandidate(effect, found, site, False, (), low, high)


def seen(x: np.ndarray, y: np.ndarray, integral_of: str = "") -> EffectCurve:
    return EffectCurve("e", "", "z", x=x, y=y, integral_of=integral_of)


def name(units, site, form, *variables, values=None, curve=None, way=1) -> str:
    made = candidate(site, form, *variables, way=way)
    given_values = [1.0] * len(made.form.coefficients) if values is None else values
    return Namer(description(**units), {}).name(made, given_values, curve).words


def der(state: str) -> EffectSite:
    return EffectSite("derivative", state)


def pair(first: str, second: str) -> EffectSite:
    return EffectSite("pair", first, second)


UP = np.linspace(0.3, 2.1, 50)
BOTH = np.linspace(-2.0, 2.0, 50)

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
    ("V", "viscous", "a term linear in z"),
    ("m", "viscous", "a term linear in z"),
    ("1/s", "viscous", "a term linear in z"),
    ("1", "viscous", "a term linear in z"),
    ("%", "quadratic", "a term quadratic in z that has its sign"),
    ("", "viscous", "a term linear in z"),
    ("foo^-3", "coulomb", "a term that switches with the sign of z"),
]


@pytest.mark.parametrize(("unit", "form", "words"), AT_ITSELF)
def test_a_law_of_a_state_at_its_own_rate(unit, form, words):
    assert name({"z": unit}, der("z"), form, "z") == words


def test_what_feeds_energy_in_is_no_friction():
    assert name({"v": "m/s"}, der("v"), "viscous", "v", values=[-1.0]) == "a term linear in v"
    assert name({"p": "Pa"}, der("p"), "linear", "p", values=[1.0]) == "a term linear in p"


def test_a_law_of_another_speed_is_no_friction():
    units = {"v": "m/s", "w": "m/s"}
    assert name(units, der("v"), "linear", "w", values=[-1.0]) == "a term linear in w"


def test_a_square_is_drag_only_where_the_speed_keeps_its_sign_and_is_slowed():
    units, site = {"v": "m/s"}, der("v")
    assert name(units, site, "square", "v", values=[-1.0], curve=seen(UP, -(UP**2))) == "drag"
    faster = name(units, site, "square", "v", values=[1.0], curve=seen(UP, UP**2))
    assert faster == "a term quadratic in v"
    both = name(units, site, "square", "v", values=[-1.0], curve=seen(BOTH, -(BOTH**2)))
    assert both == "a term quadratic in v"
    assert name(units, site, "square", "v", values=[-1.0]) == "a term quadratic in v"


def test_friction_whose_level_depends_on_something_names_that():
    units, site = {"v": "m/s", "p": "bar"}, der("v")
    against, partly = seen(BOTH, -np.abs(BOTH)), seen(BOTH, BOTH)
    pressed = name(units, site, "load_dependent_coulomb", "v", "p", curve=against)
    assert pressed == "Coulomb friction proportional to the magnitude of p"
    placed = name(units, site, "coulomb_table", "v", "p", curve=against)
    assert placed == "Coulomb friction that depends on p"
    driving = name(units, site, "coulomb_table", "v", "p", curve=partly)
    assert driving == "a term that switches with the sign of v, by a free curve of p"
    drawn = name({}, site, "load_dependent_coulomb", "v", "p", curve=against)
    assert drawn == "a term that switches with the sign of v, proportional to the magnitude of p"


def test_between_two_states():
    heat = name({"a": "degC", "b": "degC"}, pair("a", "b"), "linear", "a - b")
    assert heat == "heat conduction or convection"
    moving = {"a": "rad/s", "b": "rad/s"}
    assert name(moving, pair("a", "b"), "linear", "a - b") == "viscous friction"
    assert name(moving, pair("a", "b"), "linear") == "viscous friction"
    tanks = {"a": "m", "b": "m", "area": "m2"}
    assert name(tanks, pair("a", "b"), "leak", "a - b") == "flow through an orifice"
    unlike = {"a": "rad/s", "b": "m/s"}
    assert name(unlike, pair("a", "b"), "linear", "a - b") == "a term linear in (a - b)"


def test_over_to_what_is_around_a_state():
    warm = {"T": "degC", "T_ambient": "degC"}
    assert name(warm, der("T"), "radiation", "T", "T_ambient") == "thermal radiation"
    lost = name(warm, der("T"), "power", "T - T_ambient")
    assert lost == "heat loss by a power law (as of natural convection)"
    assert name(warm, der("T"), "linear", "T - T_ambient", values=[-1.0]) == "heat loss"
    other = name(warm, der("T"), "linear", "T_ambient", values=[-1.0])
    assert other == "a term linear in T_ambient"


def test_a_length_is_a_level_only_where_nothing_moves():
    assert name({"h": "m", "area": "m2"}, der("h"), "viscous", "h") == "leakage"
    still = {"h": "m", "area": "m2", "v": "m/s"}
    assert name(still, der("h"), "viscous", "h") == "a term linear in h"


def test_a_position_needs_to_be_the_integral_of_what_is_changed():
    units = {"x": "m", "v": "m/s"}
    own = seen(BOTH, -BOTH, "v")
    spring = name(units, der("v"), "linear", "x", values=[-1.0], curve=own)
    assert spring == "stiffness (a spring)"
    other = seen(BOTH, -BOTH, "v2")
    assert name(units, der("v"), "linear", "x", curve=other) == "a term linear in x"
    beyond = np.maximum(BOTH - 1.0, 0.0)
    stop = name(units, der("v"), "hinge", "x", curve=seen(BOTH, -beyond, "v"))
    assert stop == "end stop"
    away = name(units, der("v"), "hinge", "x", curve=seen(BOTH, beyond, "v"))
    assert away == "a term linear in x above a threshold"
    angle = {"x": "rad", "v": "rad/s"}
    wave = seen(BOTH, np.sin(4.0 * BOTH), "v")
    assert name(angle, der("v"), "periodic", "x", curve=wave) == "cogging or eccentricity"


def test_a_force_at_an_input_needs_to_know_how_it_pushes():
    units, site = {"F": "N", "v": "m/s"}, EffectSite("input", "F")
    assert name(units, site, "coulomb", "v") == "Coulomb friction"
    assert name(units, site, "coulomb", "v", values=[-1.0, 1.0], way=-1) == "Coulomb friction"
    unknown = name(units, site, "coulomb", "v", way=0)
    assert unknown == "a term that switches with the sign of v"
    torque = name({"F": "N.m", "v": "m/s"}, site, "viscous", "v")
    assert torque == "a term linear in v"


def test_heat_that_comes_from_elsewhere():
    heated = {"T": "K", "i": "A", "P": "W"}
    squared = seen(BOTH, BOTH**2)
    assert name(heated, der("T"), "square", "i", curve=seen(UP, UP**2)) == "Joule heating"
    assert name(heated, der("T"), "square", "i", curve=squared) == "a term quadratic in i"
    assert name(heated, der("T"), "linear", "P", values=[1.0]) == "heating"
    flow = {"T": "K", "m": "kg/s"}
    carried = name(flow, der("T"), "product", "m", "T")
    assert carried == "convection (heat that a flow carries)"


def test_signals_have_names_without_units():
    assert name({"u": ""}, EffectSite("input", "u"), "dead_zone") == "a dead zone"
    assert name({"y": "foo"}, EffectSite("output", "y"), "bias") == "an offset"


def test_a_parameter_that_falls_with_a_concentration_is_inhibited():
    units, site = {"mu": "1/h", "S": "g/l"}, EffectSite("parameter", "mu")
    falls = seen(np.linspace(0.0, 2.0, 50), 1.0 - np.linspace(0.0, 2.0, 50) / 4.0)
    assert name(units, site, "saturating", "S", curve=falls) == "inhibition"
    assert name(units, site, "saturating", "S") == "a variation that saturates in S"


def test_a_resistance_that_follows_the_squared_current_warms_up():
    units, site = {"R": "Ohm", "i": "A", "w": "rad/s"}, EffectSite("parameter", "R")
    assert name(units, site, "heating", "i") == "self-heating by the current"
    other = name(units, site, "heating", "w")
    assert other == "a variation in the lagged square of w"


def test_a_reaction_of_second_order_and_a_relief_valve():
    amounts = np.linspace(0.1, 2.0, 50)
    squared = seen(amounts, -(amounts**2))
    reaction = name({"c": "mol/l"}, der("c"), "square", "c", curve=squared)
    assert reaction == "second-order loss (as of a reaction)"
    opened = seen(amounts, -np.maximum(amounts - 1.0, 0.0))
    relieved = name({"p": "bar"}, der("p"), "hinge", "p", curve=opened)
    assert relieved == "outflow above a threshold (as of a relief valve)"
    assert name({"V": "m3"}, der("V"), "hinge", "V", curve=opened) == "overflow"


def test_units_of_a_config_count_too():
    made = candidate(der("v"), "viscous", "v")
    assert Namer(description(v=""), {}).name(made, [1.0], None).words == "a term linear in v"
    named = Namer(description(v="m/s"), {}).name(made, [1.0], None)
    assert named.words == "viscous friction"
    assert named.physical
    signal = candidate(der("T"), "linear", "sun")
    words = Namer(description(T="degC"), {"sun": "W/m2"}).name(signal, [1.0], None).words
    assert words == "heating"


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
    one, other = (
        name({"z": unit}, der("z"), form[1], "z", values=values) for unit in units
    )  # fmt: skip
    assert one == other
