"""The law of an equation, read from the equation."""

from __future__ import annotations

import pytest

from cluster_est.closed_loop.findings.words.laws import Law, law_of
from workers.effects.forms import FORMS
from workers.effects.kinds import EffectForm, FormCoefficient

LAWS = {
    ("derivative", "viscous"): Law.LINEAR,
    ("derivative", "linear"): Law.LINEAR,
    ("derivative", "square"): Law.SQUARE,
    ("derivative", "quadratic"): Law.ODD_SQUARE,
    ("derivative", "cubic"): Law.CUBE,
    ("derivative", "power"): Law.POWER,
    ("pair", "power"): Law.POWER,
    ("input", "power_characteristic"): Law.POWER,
    ("parameter", "power"): Law.POWER,
    ("parameter", "exponential"): Law.EXPONENTIAL,
    ("derivative", "exponential"): Law.EXPONENTIAL,
    ("derivative", "contact"): Law.ABOVE_BY_POWER,
    ("derivative", "radiation"): Law.FOURTH_DIFFERENCE,
    ("pair", "radiation"): Law.FOURTH_DIFFERENCE,
    ("parameter", "inverse"): Law.INVERSE,
    ("parameter", "inverse_square"): Law.INVERSE_SQUARE,
    ("derivative", "coulomb"): Law.SWITCH,
    ("derivative", "stribeck"): Law.SWITCH_WITH_PEAK,
    ("derivative", "asymmetric_coulomb"): Law.TWO_SWITCHES,
    ("derivative", "load_dependent_coulomb"): Law.SWITCH_BY_MAGNITUDE,
    ("derivative", "coulomb_table"): Law.SWITCH_BY_CURVE,
    ("derivative", "dahl"): Law.HYSTERESIS,
    ("derivative", "square_root"): Law.ROOT,
    ("derivative", "signed_root"): Law.ODD_ROOT,
    ("derivative", "hinge"): Law.ABOVE,
    ("derivative", "hinge_below"): Law.BELOW,
    ("derivative", "gap"): Law.GAP,
    ("derivative", "saturating"): Law.SATURATING,
    ("derivative", "periodic"): Law.PERIODIC,
    ("derivative", "periodic_travel"): Law.PERIODIC_TRAVEL,
    ("derivative", "product"): Law.PRODUCT,
    ("derivative", "lagged"): Law.LAGGED,
    ("derivative", "table"): Law.CURVE,
    ("derivative", "constant"): Law.CONSTANT,
    ("derivative", "sine"): Law.WAVE,
    ("pair", "joint"): Law.CLIPPED,
    ("pair", "linear"): Law.LINEAR,
    ("pair", "leak"): Law.ODD_ROOT,
    ("input", "coulomb"): Law.SWITCH,
    ("input", "viscous"): Law.LINEAR,
    ("parameter", "linear"): Law.LINEAR,
    ("parameter", "saturating"): Law.SATURATING,
    ("parameter", "hill"): Law.HILL,
    ("parameter", "heating"): Law.LAGGED_SQUARE,
    ("output", "hum"): Law.WAVE,
}


@pytest.mark.parametrize(("form", "law"), LAWS.items())
def test_forms_of_the_library(form, law):
    assert law_of(FORMS[form]) is law


@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_every_form_has_a_law(kind, name):
    assert isinstance(law_of(FORMS[kind, name]), Law)


@pytest.mark.parametrize(
    ("equation", "law"),
    [
        ("k * (v^4 - at^4)", Law.FOURTH),
        ("k * v / (at + v + v^2 / L)", Law.INHIBITED),
        ("k / (1 + v / at)", Law.INHIBITED),
        ("k * v / (at + v)", Law.SATURATING),
        ("-k * sign(v)", Law.SWITCH),
        ("k * abs(v)", Law.ABSOLUTE),
        ("k * v * abs(v) + k * v", Law.OTHER),
        ("k * exp(v / at)", Law.EXPONENTIAL),
        ("-k * (exp(abs(v) / at) - 1) * tanh(v / L)", Law.OTHER),
    ],
)
def test_equations_that_the_library_may_have_one_day(equation, law):
    names = [n for n in ("k", "at", "L") if n in equation]
    coefficients = tuple(FormCoefficient(n, None) for n in names)
    form = EffectForm("new", "new", ("derivative",), equation, coefficients, 1)
    assert law_of(form) is law
