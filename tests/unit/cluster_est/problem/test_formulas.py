import math
import pickle
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_est.errors import ClusterEstError, ProblemError
from cluster_est.problem.formulas import Formula, parse_constraint

NAMES = ("a", "b", "motor.k")
COLUMNS = {
    "a": np.array([1.0, 2.5, -3.0]),
    "b": np.array([2.0, -1.0, 0.5]),
    "motor.k": np.array([4.0, 0.25, 9.0]),
}
BY_HAND = {
    "exp": math.exp, "tanh": math.tanh, "atan": math.atan, "sin": math.sin, "cos": math.cos,
    "abs": abs, "min": min, "max": max,
    "where": lambda condition, yes, no: yes if condition else no,
    "sign": lambda value: math.copysign(1.0, value) if value else 0.0,
}  # fmt: skip


def values(text):
    return Formula(text, NAMES, "here").values(COLUMNS, 3)


def one_by_one(text):
    """The same with Python's arithmetic, number by number."""
    code = text.replace("^", "**").replace("motor.k", "k")
    rows = zip(COLUMNS["a"], COLUMNS["b"], COLUMNS["motor.k"], strict=True)
    return [
        float(eval(code, {"__builtins__": {}}, BY_HAND | {"a": a, "b": b, "k": k}))
        for a, b, k in rows
    ]


@pytest.mark.parametrize(
    "text",
    [
        "-a^2",
        "2^-1 * a",
        "max(a, 1, b)",
        "where(a >= 2.5, 1, 0) + max(b, 0.25)",
        "exp(-a) + tanh(b) - atan(motor.k) * cos(a) / sin(b)",
        "motor.k^0.5",
        "7",
        "  a  ",
        "1e-3 * a",
        "0x10 * a",
    ],
)
def test_a_formula_gives_what_python_gives(text):
    np.testing.assert_allclose(values(text), one_by_one(text), rtol=1e-14)


_LEAVES = st.sampled_from(["a", "b", "motor.k", "1", "3", "0.5", "2.25"])
_SIGNS = st.sampled_from(["<", ">"])
_FORMULAS = st.recursive(
    _LEAVES,
    lambda inner: st.one_of(
        st.builds("({} {} {})".format, inner, st.sampled_from("+-*"), inner),
        st.builds("{}({})".format, st.sampled_from(["tanh", "atan", "abs", "sign"]), inner),
        st.builds("{}({}, {})".format, st.sampled_from(["min", "max"]), inner, inner),
        st.builds("where({} {} {}, {}, {})".format, inner, _SIGNS, inner, inner, inner),
        st.builds("-({})".format, inner),
        st.builds("({})/4".format, inner),
    ),
    max_leaves=6,
)


@settings(max_examples=80)
@given(_FORMULAS)
def test_any_formula_gives_what_python_gives(text):
    found = values(text)
    assert (found.shape, found.dtype) == ((3,), np.float64)
    np.testing.assert_allclose(found, one_by_one(text), rtol=1e-9, atol=1e-9)


def test_it_names_what_it_depends_on():
    assert Formula("b + 2 * motor.k", NAMES).names == ("b", "motor.k")
    assert Formula("3", NAMES).names == ()
    assert Formula("a - a + b", NAMES).names == ("b",)


def test_where_it_has_no_value_it_is_not_a_number():
    np.testing.assert_array_equal(np.isnan(values("sqrt(a)")), [False, False, True])
    np.testing.assert_array_equal(np.isnan(values("log(b)")), [False, True, False])
    assert values("1 / (a - 1)")[0] == np.inf
    assert values("exp(1000 * a)")[0] == np.inf


def test_a_constant_has_as_many_values_as_there_are_experiments():
    found = Formula("2 * 3", ()).values({}, 4)
    assert found.tolist() == [6.0] * 4
    found[0] = 1.0  # it is its owner's


def test_it_travels_as_text():
    formula = Formula("a + b^2", NAMES, "here")
    formula.values(COLUMNS, 3)
    again = pickle.loads(pickle.dumps(formula))
    assert again == formula
    assert again.values(COLUMNS, 3).tobytes() == formula.values(COLUMNS, 3).tobytes()


MADE_OF = "consist of numbers"


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("", "an equation, but '' is not"),
        ("a +", r"an equation, but 'a \+' is not \(invalid syntax\)"),
        ("aa", "unknown variable 'aa'.*'a'"),
        ("motor.j", "unknown variable 'motor.j'.*'motor.k'"),
        ("a.__class__", "unknown variable 'a.__class__'"),
        ("__import__('os')", "unknown function '__import__'"),
        ("__import__('os').system('true')", MADE_OF),
        ("a[0]", MADE_OF),
        ("'a'", MADE_OF),
        ("1j * a", MADE_OF),
        ("a and b", MADE_OF),
        ("exp(*a)", MADE_OF),
        ("a > b", "a number for all values of the parameters, but 'a > b' is true or false"),
        ("a * (b > 1)", "not compute with a comparison"),
        ("-(a > 1)", "not compute with a comparison"),
        ("min(a > 1, 2)", r"min\(...\) cannot be used in this way"),
        ("where(a, 1)", r"where\(...\) cannot be used in this way"),
        ("a / 0", "a finite value"),
        ("where(a > 2, a, b / 0)", "a finite value"),
        ("sqrt(-1) * a", "a finite value"),
        ("max()", "a finite value"),
        ("10^400 * a", "a finite value"),
        ("9^9^9^9 * a", "an exponent must be at most 1000"),
        ("a^(9^9^9)", "an exponent must be at most 1000"),
        ("a" * 3000, "at most 2000 characters, but has 3000"),
        ("(" * 300 + "a" + ")" * 300, "an equation"),
    ],
)
def test_anything_else_is_refused_in_a_sentence(text, pattern):
    with pytest.raises(ProblemError) as refused:
        Formula(text, NAMES, "parameters.c.expression")
    said = str(refused.value)
    assert re.search(f"^parameters.c.expression: .*{pattern}", said), said
    assert "\n" not in said


@settings(max_examples=150)
@given(st.text(alphabet="ab10.+-*/^()<>= ,whermaxsqt", max_size=14))
def test_no_text_does_anything_but_give_numbers_or_a_sentence(text):
    try:
        formula = Formula(text, NAMES, "here")
    except ClusterEstError as error:
        assert str(error).startswith("here: ")  # noqa: PT017
        return
    found = formula.values(COLUMNS, 3)
    assert (found.shape, found.dtype) == ((3,), np.float64)


LOWER, UPPER = " (lower)", " (upper)"


@pytest.mark.parametrize(
    ("text", "sides", "by_hand"),
    [
        ("a <= b", [""], [lambda a, b: a - b]),
        ("a < b", [""], [lambda a, b: a - b]),
        ("a >= b", [""], [lambda a, b: b - a]),
        ("a>b", [""], [lambda a, b: b - a]),
        ("a + b = 1", ["="], [lambda a, b: a + b - 1.0]),
        ("a == 2*b", ["="], [lambda a, b: a - 2.0 * b]),
        ("0 <= a - b <= 1", [LOWER, UPPER], [lambda a, b: b - a, lambda a, b: a - b - 1.0]),
        ("1 >= a - b >= 0", [UPPER, LOWER], [lambda a, b: a - b - 1.0, lambda a, b: b - a]),
        ("where(a <= b, a, 2*b) <= 3", [""], [lambda a, b: np.where(a <= b, a, 2.0 * b) - 3.0]),
        ("  a<=1  ", [""], [lambda a, b: a - 1.0]),
    ],
)
@pytest.mark.parametrize("name", ["", "order"])
def test_a_constraint_is_left_minus_right(text, sides, by_hand, name):
    """And is called as its author says, or as it is written."""
    found = parse_constraint(text, NAMES, "here", name, 2.0)
    called = name or text.strip()
    assert [c.name for c in found] == [called + side.strip("=") for side in sides]
    assert [c.equality for c in found] == [side == "=" for side in sides]
    for constraint, expected in zip(found, by_hand, strict=True):
        assert constraint.scale == 2.0
        truth = expected(COLUMNS["a"], COLUMNS["b"])
        np.testing.assert_allclose(constraint.formula.values(COLUMNS, 3), truth, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("a", "two formulas with <=, >= or = between them, but is 'a'"),
        ("", "two formulas"),
        ("a => b", "two formulas"),
        ("a <= b <= 1 <= 2", "two formulas"),
        ("(a <= b)", "two formulas"),
        ("a != b", "an equation, but 'a !' is not"),
        ("a) + (b <= 1", r"an equation, but 'a\) \+ \(b' is not"),
        ("a <= b # or not", "an equation"),
        ("a <= c", "unknown variable 'c'"),
        ("1 <= 2", "name a parameter, but '1 <= 2' names none"),
        ("a - a <= 1", "name a parameter"),
        ("a <= 1/0", "a finite value, but '1/0' has none"),
    ],
)
def test_no_other_text_is_a_constraint(text, pattern):
    with pytest.raises(ProblemError, match=rf"^constraints\[0\].expression: .*{pattern}"):
        parse_constraint(text, NAMES, "constraints[0].expression")
