"""Max, min and abs of equations keep their arguments, and are what NumPy says."""

from __future__ import annotations

import pickle

import numpy as np
import sympy as sp

from workers.effects.expression import parse
from workers.effects.plain_functions import Abs, Max, Min, simplified

X, Y = sp.symbols("x y", real=True)


def read(text: str) -> sp.Expr:
    return parse(text, {"x": X, "y": Y}, "here")


def test_values_are_those_of_numpy():
    equation = read("x * max(x - y, 0) + min(y, 1, 2 * x) - max(abs(x), y)")
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 2)):
        wanted = x * max(x - y, 0.0) + min(y, 1.0, 2.0 * x) - max(abs(x), y)
        assert np.isclose(float(equation.subs({X: x, Y: y})), wanted, rtol=1e-12, atol=1e-12)


def test_arguments_stay_as_they_are():
    assert read("max(x^2 + 1, 0)") == Max(X**2 + 1, 0)
    assert len(Max(X**2 + 1, 0).args) == 2
    assert read("abs(x^2 - y)") == Abs(X**2 - Y)
    assert isinstance(Max(X, Y).xreplace({X: Y**2}), Max)


def test_numbers_have_a_value():
    assert read("max(1, 3) + min(4, 2)") == 5
    assert read("abs(2 - 5)") == 3
    assert Abs(X).subs(X, -2) == 2
    assert Min(X, Y).subs({X: 1, Y: 2}) == 1


def test_they_are_found_as_those_of_sympy_are():
    equation = read("x * max(x, y)")
    assert equation.has(sp.Max)
    assert equation.atoms(sp.Max) == {Max(X, Y)}
    assert pickle.loads(pickle.dumps(equation)) == equation


def test_derivatives_are_steps():
    slope = sp.lambdify((X, Y), sp.diff(read("max(x - y, 0)"), X))
    assert slope(2.0, 1.0) == 1.0
    assert slope(1.0, 2.0) == 0.0


def test_sympy_looks_at_their_form_when_asked():
    assert simplified(read("max(x^2, -1) + abs(2 * x)")) == X**2 + 2 * sp.Abs(X)
