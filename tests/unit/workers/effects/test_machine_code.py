import ctypes
import gc
import math
import pickle

import numpy as np
import pytest
import sympy as sp
from support.problems.springs import FMU

from workers.effects.compiled import READ_ARRAYS, equations
from workers.effects.definition import TIME_SYMBOL, define
from workers.effects.expression import EQUATION_FUNCTIONS, parse
from workers.effects.forms import FORMS
from workers.effects.machine_code import (
    CAssignment,
    EffectArray,
    MachineCode,
    SymbolLocations,
    compile_function,
)
from workers.fmu.description import describe_model
from workers.messages import Effect, Model, Solver

MODEL = Model("spring", FMU.read_bytes(), "model_exchange", Solver("rk4"), ())
SITES = {
    "derivative": "der(v)", "input": "input F", "parameter": "parameter c", "pair": "pair x,v",
}  # fmt: skip
NAMES = {name: sp.Symbol(name, real=True) for name in "xy"}
LOCATIONS: SymbolLocations = {
    NAMES["x"]: (EffectArray.STATES, 0),
    NAMES["y"]: (EffectArray.STATES, 2),
}


ARRAYS = (EffectArray.STATES, EffectArray.RESULT)


def called(compiled, time, arrays):
    kinds = [ctypes.c_double, *[ctypes.c_void_p] * len(arrays)]
    function = ctypes.CFUNCTYPE(ctypes.c_int32, *kinds)(compiled.address)
    assert function(time, *(array.ctypes.data for array in arrays)) == 0


def value_of(text, x, y=0.0):
    result = np.full(2, 7.0)
    assignment = CAssignment(EffectArray.RESULT, 1, parse(text, NAMES | {"t": TIME_SYMBOL}, "here"))
    compiled = compile_function(ARRAYS, LOCATIONS, [assignment], TIME_SYMBOL)
    assert isinstance(compiled, MachineCode)
    called(compiled, 1.5, [np.array([x, -1.0, y]), result])
    assert result[0] == 7.0
    return float(result[1])


@pytest.mark.parametrize(
    "name", sorted(EQUATION_FUNCTIONS.keys() - {"where", "min", "max", "sign", "abs"})
)
def test_functions_are_those_of_the_c_library(name):
    for x in (0.3, 1.7, 25.0):
        assert value_of(f"{name}(x)", x) == getattr(math, name)(x)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x + 2 * y - 3", lambda x, y: x + 2.0 * y - 3.0),
        ("x / (y + 4)", lambda x, y: x / (y + 4.0)),
        ("x^3 + x^-2 + abs(y)^0.5", lambda x, y: x**3 + 1.0 / (x * x) + math.sqrt(abs(y))),
        ("abs(x)^1.7 + 2^y", lambda x, y: math.pow(abs(x), 1.7) + math.pow(2.0, y)),
        ("abs(x) - sign(y) + sign(x * 0)", lambda x, y: abs(x) - math.copysign(1.0, y)),
        ("min(x, y, 0.5) + max(x, y, 0.25)", lambda x, y: min(x, y, 0.5) + max(x, y, 0.25)),
        ("where(x < y, x, 2 * y)", lambda x, y: x if x < y else 2.0 * y),
        ("where(x >= 0, 1, where(y > 0, 2, 3))", lambda x, y: 1 if x >= 0 else 2 if y > 0 else 3),
        ("t * x", lambda x, y: 1.5 * x),
        ("1e300 * 1e10 * x", lambda x, y: math.copysign(math.inf, x)),
    ],
)  # fmt: skip
def test_arithmetic_is_that_of_doubles(text, expected):
    for x, y in ((0.7, -1.3), (-0.4, 2.5), (-2.0, -3.0), (1.0, 1.0)):
        assert value_of(text, x, y) == pytest.approx(expected(x, y), rel=4e-16)


def test_a_division_by_zero_is_infinite_and_what_has_no_value_is_not_a_number():
    assert value_of("1 / x", 0.0) == math.inf
    assert math.isnan(value_of("log(x)", -1.0))
    assert math.isnan(value_of("x / y", 0.0, 0.0))


def test_a_value_is_added_to_what_is_there():
    assignment = CAssignment(EffectArray.RESULT, 1, NAMES["x"] * NAMES["y"], add=True)
    compiled = compile_function(ARRAYS, LOCATIONS, [assignment], TIME_SYMBOL)
    result = np.array([1.0, 2.0])
    called(compiled, 0.0, [np.array([3.0, 0.0, 5.0]), result])
    assert result.tolist() == [1.0, 17.0]


def functions_of(kind, name):
    """The functions of a form at a site of its kind, as arrays, locations and assignments."""
    variables = ("F", "F") if kind == "input" else ("v", "x")
    effect = Effect("e", SITES[kind], name, variables[: FORMS[kind, name].variables])
    definition = define(effect, describe_model(MODEL), "model_exchange")
    found = equations((definition,), (0,), ("x", "v"), ("F",))
    changed = (EffectArray.EFFECTIVE_INPUTS, EffectArray.EFFECTIVE_PARAMETERS)
    functions = [
        (READ_ARRAYS, found.locations, found.start_states),
        ((*READ_ARRAYS, *changed), found.locations, found.modify_inputs),
        ((*READ_ARRAYS, EffectArray.DERIVATIVES), found.locations, found.add_derivatives),
    ]
    return [each for each in functions if each[2]]


@pytest.mark.parametrize(
    ("kind", "name"),
    [k for k, form in FORMS.items() if k[0] in SITES and not form.memory and "_25" not in k[1]],
)
def test_every_form_is_what_python_computes(kind, name):
    generator = np.random.default_rng(1)
    for arrays, locations, assignments in functions_of(kind, name):
        compiled = compile_function(arrays, locations, assignments, TIME_SYMBOL)
        assert isinstance(compiled, MachineCode)
        symbols = [TIME_SYMBOL, *locations]
        plain = [sp.lambdify(symbols, a.value, "numpy") for a in assignments]
        for trial in range(4):
            given = {a: generator.normal(size=40) for a in arrays}
            expected = {array: values.copy() for array, values in given.items()}
            known = [given[array][index] if array in given else 0.0 for array, index in
                     locations.values()]  # fmt: skip
            with np.errstate(all="ignore"):
                found = [float(function(0.3 * trial, *known)) for function in plain]
            for assignment, value in zip(assignments, found, strict=True):
                place = expected[assignment.target]
                place[assignment.index] = value + place[assignment.index] * assignment.add
            called(compiled, 0.3 * trial, list(given.values()))
            for array in arrays:
                np.testing.assert_allclose(given[array], expected[array], rtol=1e-11, atol=1e-13)


def test_what_is_not_known_is_left_to_numba():
    assignment = CAssignment(EffectArray.RESULT, 0, sp.cosh(NAMES["x"]))
    compiled = compile_function(ARRAYS, LOCATIONS, [assignment], TIME_SYMBOL)
    assert not isinstance(compiled, MachineCode)
    result = np.zeros(1)
    called(compiled, 0.0, [np.array([0.5, 0.0, 0.0]), result])
    assert result[0] == math.cosh(0.5)


def test_code_lives_as_long_as_its_object():
    kept = [
        compile_function(
            ARRAYS, LOCATIONS, [CAssignment(EffectArray.RESULT, 0, NAMES["x"] + n)], TIME_SYMBOL
        )
        for n in range(5)
    ]
    gc.collect()
    for n, compiled in enumerate(kept):
        result = np.zeros(1)
        called(compiled, 0.0, [np.array([0.5, 0.0, 0.0]), result])
        assert result[0] == 0.5 + n


X, Y = sp.symbols("x y", real=True)


def read(text):
    return parse(text, {"x": X, "y": Y}, "here")


def test_values_are_those_of_numpy():
    equation = read("x * max(x - y, 0) + min(y, 1, 2 * x) - max(abs(x), y)")
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 2)):
        wanted = x * max(x - y, 0.0) + min(y, 1.0, 2.0 * x) - max(abs(x), y)
        assert np.isclose(float(equation.subs({X: x, Y: y})), wanted, rtol=1e-12, atol=1e-12)
    assert read("max(1, 3) + min(4, 2) - abs(2 - 5)") == 2


def test_arguments_stay_as_they_are_and_are_found_as_those_of_sympy_are():
    equation = read("x * max(x^2 + 1, 0) + abs(x^2 - y)")
    assert equation.has(sp.Max, sp.Abs)
    (largest,) = equation.atoms(sp.Max)
    assert set(largest.args) == {X**2 + 1, sp.Integer(0)}
    assert equation.xreplace({X: Y**2}).has(sp.Max)
    assert pickle.loads(pickle.dumps(equation)) == equation


def test_derivatives_are_steps():
    slope = sp.lambdify((X, Y), sp.diff(read("max(x - y, 0)"), X))
    assert slope(2.0, 1.0) == 1.0
    assert slope(1.0, 2.0) == 0.0
