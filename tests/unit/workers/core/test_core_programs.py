"""Byte code of effects: the same values as the equations, and nothing that could do harm."""

import math
import random

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st
from support.core_programs import CODES, FAST, PLAIN, SIMULATED, Machines, form_program, written
from support.thinning import thinned

from workers.core.assemble import (
    OPERATIONS,
    TIME_SYMBOL,
    Assignment,
    EffectArray,
    Registers,
    assemble,
)
from workers.core.library import LoadedProgram
from workers.effects.expression import EQUATION_FUNCTIONS, parse
from workers.effects.forms import FORMS
from workers.errors import EffectError, ModelError

X, Y = (sp.Symbol(name, real=True) for name in "xy")
LOCATIONS = {X: (EffectArray.STATES, 0), Y: (EffectArray.STATES, 1)}
NAMES = {"x": X, "y": Y, "t": TIME_SYMBOL}


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    return Machines(tmp_path_factory.mktemp("machines"))


@pytest.fixture
def value_of(machines):
    """The value of an equation of two states."""

    def value(text, x, y=0.0):
        equation = parse(text, NAMES, "here")
        added = Assignment(EffectArray.DERIVATIVES, 0, equation, add=True)
        code = assemble(Registers(2, 0, 0, 0), LOCATIONS, after=[added])
        return float(machines.evaluated(code, [1.5, x, y], 1)[0])

    return value


def random_registers(form, trial):
    """Of which coefficients are positive in half of the trials."""
    generator = np.random.default_rng(trial)
    given = generator.normal(size=form.n_given)
    first = 1 + form.registers.states + form.registers.inputs
    if trial % 2 == 0:
        given[first:] = np.abs(given[first:])
    return given


def values_in_python(form, given):
    """The same by NumPy: effective inputs and parameters, then what derivatives are changed by."""
    laid_out, r = form.equations, form.registers
    sizes = {"states": r.states, "inputs": r.inputs, "coefficients": r.coefficients, "base": r.base}
    first = dict(zip(sizes, np.cumsum([1, *sizes.values()]), strict=False))
    known = [given[first[array] + index] for array, index in laid_out.locations.values()]
    symbols = [TIME_SYMBOL, *laid_out.locations]
    with np.errstate(all="ignore"):
        return [
            float(sp.lambdify(symbols, assignment.value, "numpy")(given[0], *known))
            for assignment in (*laid_out.modify_inputs, *form.sites)
        ]


@pytest.mark.parametrize(
    ("kind", "name"), thinned(SIMULATED, lambda kind, name: (kind, FORMS[kind, name].family))
)
def test_every_form_is_what_python_computes(machines, kind, name):
    form = form_program(kind, name)
    for trial in range(4):
        given = random_registers(form, trial)
        found = machines.evaluated(form.code, given, form.n_before + len(form.sites))
        expected = values_in_python(form, given)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize(
    "name", sorted(EQUATION_FUNCTIONS.keys() - {"where", "min", "max", "sign", "abs"})
)
def test_functions_are_elementary(value_of, name):
    for x in (0.3, 1.7, 25.0):
        assert value_of(f"{name}(x)", x) == pytest.approx(getattr(math, name)(x), rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x + 2 * y - 3", lambda x, y: x + 2.0 * y - 3.0),
        ("x^3 + x^-2 + abs(y)^0.5", lambda x, y: x**3 + 1.0 / (x * x) + math.sqrt(abs(y))),
        ("abs(x)^1.7 + 2^y", lambda x, y: math.pow(abs(x), 1.7) + math.pow(2.0, y)),
        ("abs(x) - sign(y) + sign(x * 0)", lambda x, y: abs(x) - math.copysign(1.0, y)),
        ("min(x, y, 0.5) + max(x, y, 0.25)", lambda x, y: min(x, y, 0.5) + max(x, y, 0.25)),
        ("where(x < y, x, 2 * y)", lambda x, y: x if x < y else 2.0 * y),
        ("where(x >= 0, 1, where(y > 0, 2, 3))", lambda x, y: 1 if x >= 0 else 2 if y > 0 else 3),
        ("t * x", lambda x, y: 1.5 * x),
        ("1e300 * 1e10 * x", lambda x, y: math.copysign(math.inf, x)),
        ("x", lambda x, y: x),
        ("7", lambda x, y: 7.0),
    ],
)
def test_arithmetic_is_that_of_doubles(value_of, text, expected):
    for x, y in ((0.7, -1.3), (-0.4, 2.5), (-2.0, -3.0), (1.0, 1.0)):
        assert value_of(text, x, y) == pytest.approx(expected(x, y), rel=4e-16)


def test_a_division_by_zero_is_infinite_and_what_has_no_value_is_not_a_number(value_of):
    assert value_of("1 / x", 0.0) == math.inf
    assert math.isnan(value_of("log(x)", -1.0))
    assert math.isnan(value_of("x / y", 0.0, 0.0))
    assert math.isnan(value_of("sign(log(x))", -1.0))  # its sign is the processor's own


def test_equal_parts_are_computed_once():
    text = "tanh(x / 0.1) * y"
    once, twice = (len(assemble(Registers(2, 0, 0, 0), LOCATIONS, after=[
        Assignment(EffectArray.DERIVATIVES, i, parse(text, NAMES, "here"), add=True)
        for i in range(count)
    ])) for count in (1, 2))  # fmt: skip
    assert twice - once == 4  # bytes of a site


def test_equations_may_have_a_condition_in_common(machines):
    texts = ("where(x < y, x, 2 * y)", "where(x < y, y ^ 2, 3 * x)", "where(x >= y, t, 1)")
    code = assemble(Registers(2, 0, 0, 0), LOCATIONS, after=[
        Assignment(EffectArray.DERIVATIVES, i % 2, parse(text, NAMES, "here"), add=True)
        for i, text in enumerate(texts)
    ])  # fmt: skip
    assert machines.evaluated(code, [1.5, 0.5, 2.0], 3).tolist() == [0.5, 4.0, 1.0]
    assert machines.evaluated(code, [1.5, 2.0, 0.5], 3).tolist() == [1.0, 6.0, 1.5]


def test_a_dead_zone_may_follow_a_dead_zone(machines):
    """Whose condition is itself one of two."""
    inner = "where(abs(x) > 1, x - sign(x), 0)"
    text = f"where(abs({inner}) > 0.5, {inner} - 0.5 * sign({inner}), 0)"
    added = Assignment(EffectArray.DERIVATIVES, 0, parse(text, NAMES, "here"), add=True)
    code = assemble(Registers(2, 0, 0, 0), LOCATIONS, after=[added])
    for x, expected in ((3.0, 1.5), (-3.0, -1.5), (1.25, 0.0), (0.5, 0.0), (-1.75, -0.25)):
        assert machines.evaluated(code, [0.0, x, 0.0], 1).item() == expected


def test_what_the_core_does_not_know_is_refused_with_a_sentence():
    unknown = Assignment(EffectArray.DERIVATIVES, 0, sp.gamma(X), add=True)
    with pytest.raises(EffectError, match="gamma"):
        assemble(Registers(2, 0, 0, 0), LOCATIONS, after=[unknown])


def test_a_coefficient_that_is_not_given_is_missed():
    own = sp.Symbol("e.at", real=True)
    reading = Assignment(EffectArray.DERIVATIVES, 0, own * X, add=True)
    located = LOCATIONS | {own: (EffectArray.COEFFICIENTS, 1)}
    with pytest.raises(
        EffectError, match=r"e\.at is entry 2 of coefficients, which has only 1 entr"
    ):
        assemble(Registers(2, 0, 0, 1), located, after=[reading])


# ---- machines ------------------------------------------------------------------------------------

BINARY = ("ADD", "SUBTRACT", "MULTIPLY", "MULTIPLY", "DIVIDE", "LEAST", "LARGEST", "LESS", "AND")
UNARY = ("MOVE", "NEGATE", "ABSOLUTE", "TANH", "NOT", "SIGN")


def random_program(generator, n_states=5):
    """Half of the instructions read what the one before has computed."""
    registers = generator.choice([n_states + 3, 14, 30])
    code = []
    for i in range(generator.randint(1, 30)):
        name = generator.choice((*BINARY, *UNARY, "CHOOSE"))
        operands = [generator.randrange(registers) for _ in range(2)]
        if i and generator.random() < 0.5:
            operands[generator.randrange(2)] = code[-1][1]
        code.append((CODES[name], generator.randrange(n_states + 1, registers), *operands))
    wanted = [generator.randrange(n_states + 1, registers), code[-1][1]]
    return written(registers, n_states, [[], [], [], code], [(0, r) for r in wanted])


def test_the_fast_machine_has_the_bits_of_the_plain_one(machines):
    generator = random.Random(1)
    for trial in range(400):
        program = random_program(generator)
        given = np.random.default_rng(trial).normal(size=6)
        fast, plain = (machines.evaluated(program, given, 2, m) for m in (FAST, PLAIN))
        np.testing.assert_array_equal(fast, plain)


def test_spoiled_bytes_are_refused():
    good = written(4, 2, [[], [], [], [(CODES["ADD"], 3, 1, 2)]], [(0, 3)])
    LoadedProgram(good)
    for bad, said in (
        (b"", "no effects"),
        (good[:-1], "no effects"),
        (b"X" + good[1:], "no effects"),
        (written(4, 2, [[], [], [], [(CODES["ADD"], 9, 1, 2)]], [(0, 3)]), "instruction"),
        (written(4, 2, [[], [], [], [(CODES["ADD"], 3, 1, 4)]], [(0, 3)]), "instruction"),
        (written(4, 2, [[], [], [], [(len(OPERATIONS), 3, 1, 2)]], [(0, 3)]), "instruction"),
        (written(4, 2, [[], [], [], [(CODES["ADD"], 1, 1, 2)]], [(0, 3)]), "instruction"),
        (written(4, 2, [[], [], [], []], [(2, 3)]), "state"),
        (written(4, 2, [[], [], [], []], own=1), "state"),
        (written(4, 2, [[], [], [], []], [(1, 3)], own=1), "state"),
        (written(2, 2, [[], [], [], []]), "counts"),
    ):
        with pytest.raises(ModelError, match=said):
            LoadedProgram(bad)


@given(st.data())
def test_any_bytes_are_refused_or_run(machines, data):
    """A program that is spoiled somewhere does no harm, whatever it computes then."""
    code = bytearray(random_program(random.Random(data.draw(st.integers(0, 20)))))
    for _ in range(data.draw(st.integers(1, 4))):
        code[data.draw(st.integers(8, len(code) - 1))] = data.draw(st.integers(0, 255))
    try:
        LoadedProgram(bytes(code))
    except ModelError:
        return
    machines.evaluated(bytes(code), np.ones(300_000), 300_000)
