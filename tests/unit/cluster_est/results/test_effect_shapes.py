import re

import numpy as np
import pytest
from support.described import fmi2
from support.thinning import thinned

from cluster_est.results.shapes.effect_shapes import part_shapes, spread_of
from workers.effects.definition import define
from workers.effects.expression import EQUATION_FUNCTIONS
from workers.effects.forms import FORMS
from workers.messages import Effect

SAME = ("abs", "exp", "sign", "sqrt", "log", "sin", "cos", "tan", "tanh", "where")
NUMPY = {name: getattr(np, name) for name in SAME}
NUMPY |= {"atan": np.arctan, "min": np.minimum, "max": np.maximum}
PLAIN = [(kind, f) for (kind, _), f in FORMS.items() if not f.memory and not f.states]
X = np.linspace(-3.0, 4.0, 57)
STATES = "abvwx"


def scalar(number, name, kind, value=""):
    opening = f'<ScalarVariable name="{name}" valueReference="{number}" {kind}>'
    return f"{opening}<Real {value}/></ScalarVariable>"


SCALARS = [
    *((name, 'causality="local"', 'start="0"') for name in STATES),
    *((f"der({x})", 'causality="local"', f'derivative="{i}"') for i, x in enumerate(STATES, 1)),
    ("u", 'causality="input"', 'start="0"'),
    ("y", 'causality="output"'),
    ("p", 'causality="parameter" variability="tunable"', 'start="1"'),
]
RATES = "".join(f'<Unknown index="{6 + i}"/>' for i in range(len(STATES)))
DESCRIPTION = fmi2(
    "".join(scalar(i, *each) for i, each in enumerate(SCALARS)),
    f"<ModelStructure><Derivatives>{RATES}</Derivatives></ModelStructure>",
)


SITES = {
    "derivative": "der(a)",
    "pair": "pair a,b",
    "input": "input u",
    "output": "output y",
    "parameter": "parameter p",
}


def test_every_function_of_an_equation_is_known_here():
    assert set(NUMPY) == set(EQUATION_FUNCTIONS)


def defined(*effect, **equation):
    return define(Effect("e", *effect, **equation), DESCRIPTION, "model_exchange")


@pytest.mark.parametrize(
    ("kind", "form"),
    thinned(
        PLAIN,
        lambda kind, form: (kind, form.variables, bool(form.reaction)),
        lambda kind, form: frozenset(re.findall(r"\w+(?=\()|\b[tsvw]\b", form.equation)),
    ),
    ids=lambda each: getattr(each, "name", each),
)
def test_every_form_is_drawn_as_its_equation(kind, form):
    made = defined(SITES[kind], form.name, ("v", "w")[: form.variables])
    parts = part_shapes(made, 2.5)
    if not parts:
        assert form.variables == 2 or form.name == "product" or form.equation == "k"
        return
    values = np.linspace(0.6, 1.7, len(form.coefficients))
    names = {c.name: v for c, v in zip(form.coefficients, values, strict=True)}
    for part, text in zip(parts, (form.equation, form.reaction), strict=False):
        over_signal = part.argument == made.site.target
        at = {"t": X, "v": X, "s": X if over_signal else 2.5} | names
        if part.positive:
            at |= {"v": np.inf, "w": X}
        with np.errstate(all="ignore"):
            expected = eval(text.replace("^", "**"), {"__builtins__": {}}, NUMPY | at)
            if kind in ("input", "output") and not over_signal:
                expected = expected - 2.5
        found = part.shape(X, values)
        assert found == pytest.approx(np.broadcast_to(expected, X.shape), rel=1e-9, abs=1e-12)


def test_a_difference_of_two_states_is_one_argument():
    made = defined("pair a,b", "linear", ("a - b",))
    first, second = part_shapes(made)
    assert (first.argument, second.argument) == ("a - b", "a - b")
    values = np.array([0.7, 0.3])[: len(made.coefficients)]
    assert first.shape(X, values) == pytest.approx(-0.7 * X)
    assert np.all(np.sign(second.shape(X, values)) == np.sign(X))


def test_a_switched_function_of_another_variable_is_drawn_for_one_direction():
    (part,) = part_shapes(defined("der(v)", "load_dependent_coulomb", ("v", "x")))
    assert (part.argument, part.positive) == ("x", "v")
    assert part.shape(X, np.array([0.5, 0.01])) == pytest.approx(-0.5 * np.abs(X))


@pytest.mark.parametrize(
    ("equation", "argument", "truth"),
    [("-a * x^3", "x", -0.5 * X**3), ("a * sin(t)", "time", 0.5 * np.sin(X)), ("a * x * v", "", 0)],
)
def test_an_equation_of_ones_own_is_a_function_of_what_stands_in_it(equation, argument, truth):
    parts = part_shapes(defined("der(v)", equation=equation, coefficients=(("a", 0.0),)))
    assert [part.argument for part in parts] == ([argument] if argument else [])
    for part in parts:
        assert part.target == "v"
        assert part.shape(X, np.array([0.5])) == pytest.approx(truth)


def test_the_band_is_that_of_a_straight_line():
    """Of a + b x, whose variance is known exactly."""
    covariance = np.array([[0.04, -0.01], [-0.01, 0.09]])
    found = spread_of(lambda x, c: c[0] + c[1] * x, X, np.array([1.0, 2.0]), covariance)
    assert found == pytest.approx(np.sqrt(0.04 - 0.02 * X + 0.09 * X**2), rel=1e-6)


def test_a_coefficient_that_is_not_determined_leaves_no_band():
    found = spread_of(lambda x, c: c[0] * x, X, np.array([1.0]), np.array([[np.nan]]))
    assert np.isnan(found).all()
