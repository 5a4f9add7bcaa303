"""What a search reads of the library: every form says what it must know, in the words agreed on."""

import re
from itertools import product

import numpy as np
import pytest

from workers.effects.definition import coefficients
from workers.effects.expression import EQUATION_FUNCTIONS
from workers.effects.forms import FORMS, FormCondition, GridScale, positive
from workers.effects.signal_memory import MEMORIES
from workers.effects.site import split_variable
from workers.messages import Effect

WORDS = {"site", "other", "v", "w", "s", "second", "rad", "travel"}


@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_what_is_no_strength_has_a_grid_and_all_has_a_unit(kind, name):
    form = FORMS[kind, name]
    conditions = isinstance(form.when, tuple) and {type(each) for each in form.when}
    assert conditions in (set(), {FormCondition}), "`when` is a tuple: when=(FormCondition.OWN,)"
    assert form.memory in ("", *MEMORIES), "write its memory in workers/effects/signal_memory.py"
    assert bool(form.reaction) is (kind == "pair"), "at a pair, and only there, it has a `reaction`"
    for c in form.coefficients:
        assert isinstance(c.scale, GridScale) is bool(c.grid), (
            f"{c.name}: `grid` and its `scale`, a GridScale, go together: both or neither"
        )
        assert c.neutral == 0.0 or c.grid, (
            f"{c.name}: what is not 0 where the form does nothing needs a `grid` to start from"
        )
        assert c.grid or not c.held, f"{c.name}: what is held stays at a value of its `grid`"
        assert c.unit, f'{c.name}: needs a unit in words, such as unit="site / v"'
        unknown = set(re.findall(r"[a-z]+", c.unit)) - WORDS
        assert unknown == set(), f"{c.name}: words of a unit are {', '.join(sorted(WORDS))}"


@pytest.mark.parametrize(
    ("effect", "signs"),
    [
        (Effect("e", "der(v)", "cubic"), [True]),
        (Effect("e", "der(v)", "cubic", ("v",)), [True]),
        (Effect("e", "der(v)", "cubic", ("x",)), [False]),
        (Effect("e", "der(v)", "gap", ("x",)), [True, True]),
        (Effect("e", "der(v)", "linear"), [False]),
        (Effect("e", "pair v,w", "cubic"), [True, True]),
    ],
)
def test_a_drag_must_take_energy_out_only_of_its_own_state(effect, signs):
    assert [c.positive for c in coefficients(effect, "here")] == signs


def test_a_caller_may_ask_for_the_sign_itself():
    (k,) = FORMS["derivative", "quadratic"].coefficients
    assert positive(k, own=True)
    assert not positive(k, own=False)


def test_only_known_names_tell_what_a_minus_is():
    known = ["a.b", "x-1", "x[1,2]", "x", "1"]
    assert split_variable("a.b - x[1,2]", known) == ("a.b", "x[1,2]")
    assert split_variable(" x-1 ", known) == ("x-1",)
    assert split_variable("x - x-1", known) == ("x", "x-1")
    assert split_variable("2 * x", known) == ()


MATHEMATICS = {name: getattr(np, name) for name in EQUATION_FUNCTIONS} | {"max": max, "min": min}


def size_of(unit, scales):
    """By which factor a number changes whose unit is that, where its words change by `scales`."""
    over, _, under = unit.partition(" / ")
    factors = [
        scales[word] ** (sign * float(power or 1.0))
        for sign, part in ((1.0, over), (-1.0, under))
        for word, power in re.findall(r"([a-z]+)(?:\^([\d.]+))?", part)
    ]
    return float(np.prod(factors))


def evaluated(equation, values):
    return eval(equation.replace("^", "**"), {"__builtins__": {}}, MATHEMATICS | values)


@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_units_of_coefficients_are_those_that_the_equation_needs(kind, name):
    """In other units of everything, the same term comes out in other units, and nothing else."""
    form, generator = FORMS[kind, name], np.random.default_rng(0)
    words = ("site", "other", "v", "w", "second")
    scales = dict(zip(words, generator.uniform(0.5, 2.0, 5), strict=True))
    if FormCondition.AROUND in form.when:  # both have one unit
        scales["w"] = scales["v"]
    scales |= {"s": scales["site"], "rad": 1.0, "travel": scales["v"] * scales["second"]}
    units = {"s": "site", "v": "v", "w": "w", "t": "second"}
    units |= {c.name: c.unit for c in form.coefficients}
    values = {word: generator.uniform(0.2, 0.9) for word in units}
    values |= {"low": 0.1, "high": 0.95} if "low" in units else {}
    other = {word: value * size_of(units[word], scales) for word, value in values.items()}
    values |= {state.name: 0.6 for state in form.states}
    rates = [evaluated(state.derivative, values) for state in form.states]
    fitting = []
    for units in product(("v", "travel", "v^2", "s", "1"), repeat=len(form.states)):
        sizes = [size_of(unit, scales) for unit in units]
        own = {z.name: 0.6 * size for z, size in zip(form.states, sizes, strict=True)}
        found = [evaluated(state.derivative, other | own) for state in form.states]
        expected = [rate * size / scales["second"] for rate, size in zip(rates, sizes, strict=True)]
        if found == pytest.approx(expected, rel=1e-9):
            fitting.append(own)
    assert fitting, "no units of its states make their derivatives ones of those units / second"
    both = ((form.equation, "site"), (form.reaction or "0", "other"))
    expected = [evaluated(equation, values) * scales[unit] for equation, unit in both]
    found = [[evaluated(equation, other | own) for equation, _ in both] for own in fitting]
    assert any(each == pytest.approx(expected, rel=1e-9, abs=1e-12) for each in found), (
        f"{form.equation} must have the unit of the site, and its reaction that of the other one, "
        "but have not with the units of "
        f"{', '.join(f'{c.name}: {c.unit}' for c in form.coefficients)}"
    )


FIRST = {
    "derivative": """constant: k; coulomb: k width; cubic: k; dahl: k x0; drift: k; gap: k at;
        hinge: k at; hinge_below: k at; lagged: k tau; linear: k; product: k; quadratic: k;
        signed_root: k; sine: a b f; square: k; square_root: k; stribeck: k peak vs width;
        table: k1 k2 k3 k4 k5 k6 k7 low high; viscous: k""",
    "input": """asymmetry: k; backlash: k; bias: k; cubic: k; dead_zone: k; delay: tau; drift: k;
        gain: k; lag: tau; product: k; saturation: limit; square: k""",
    "output": """absolute: k; bias: k; clip_above: limit; clip_below: limit; delay: tau; drift: k;
        feed_through: k; gain: k; hum: a b f; hysteresis: k x0; lag: tau;
        lagged_feed_through: k tau; saturation: limit; square: k""",
    "pair": """coulomb: k back width; cubic: k back; gap: k back at; joint: k back at;
        leak: k back; linear: k back; overflow: k back at; quadratic: k back""",
    "parameter": "drift: k at; heating: k at tau; linear: k at; magnitude: k at; square: k at",
}
"""Form and coefficients at each site, as the first version had them."""


@pytest.mark.parametrize(
    ("site", "line"), [(site, line) for site, text in FIRST.items() for line in text.split(";")]
)
def test_a_form_of_the_first_version_is_still_there(site, line):
    name, _, coefficients = line.partition(":")
    form = FORMS[site, name.strip()]
    assert [c.name for c in form.coefficients] == coefficients.split()
