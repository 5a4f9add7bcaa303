"""Minima, maxima and absolute values in equations: as SymPy has them, but never rewritten."""

import pickle

import numpy as np
import sympy as sp

from workers.effects.expression import parse

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
