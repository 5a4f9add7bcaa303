"""What a search reads of the library: every form says what it must know, in the words agreed on."""

from __future__ import annotations

import re

import pytest

from workers.effects.definition import coefficients, split_variable
from workers.effects.forms import FORMS, FormCondition, GridScale, positive
from workers.effects.memory import MEMORIES
from workers.messages import Effect


@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_what_is_no_strength_has_a_grid_and_all_has_a_unit(kind, name):
    form = FORMS[kind, name]
    assert all(isinstance(condition, FormCondition) for condition in form.when)
    assert form.memory in ("", *MEMORIES)
    assert bool(form.reaction) is (kind == "pair")
    for c in form.coefficients:
        assert isinstance(c.scale, GridScale) is bool(c.grid)
        assert c.neutral == 0.0 or c.grid
        assert c.grid or not c.held
        words = set(re.findall(r"[a-z]+", c.unit))
        assert c.unit
        assert words <= {"site", "other", "v", "w", "s", "second", "rad", "travel"}


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
