"""Memories and recursions of the core, against the same in Python."""

from ctypes import c_void_p

import numpy as np
import pytest
from support.core_in_place import memory

from workers.core.library import core
from workers.effects.signal_memory import (
    SampledSignal,
    backlash,
    delay,
    rate_limit,
    rate_limit_from_rest,
)


def signals():
    """Linear and held ones, of equal and of unequal steps, some with jumps."""
    generator = np.random.default_rng(5)
    for n in (1, 2, 3, 40):
        for kind in ("linear", "hold"):
            times = np.cumsum(generator.uniform(0.01, 0.3, n))
            yield SampledSignal(times, np.round(generator.normal(size=n), 1), kind)
            yield SampledSignal(np.arange(n) * 0.1, np.sin(np.arange(n)), kind)


@pytest.mark.parametrize("form", [delay, backlash, rate_limit, rate_limit_from_rest])
@pytest.mark.parametrize("coefficient", [0.0, 1e-17, 0.3, 2.0, np.inf])
def test_a_memory_changes_a_signal_as_in_python(form, coefficient):
    if coefficient == np.inf and form in (delay, backlash):
        coefficient = 50.0
    for signal in signals():
        expected = form(signal, coefficient)
        found = memory(form.__name__, signal, coefficient)
        np.testing.assert_array_equal(found.times, expected.times)
        np.testing.assert_array_equal(found.values, expected.values)
        assert found.interpolation == expected.interpolation


def matrices(n, x, seed):
    return np.random.default_rng(seed).normal(size=(3, n, x, x)) * 0.5


def run(name, keep, first, last, whole):
    scratch = np.zeros((2, *whole.shape[1:]))
    arrays = [c_void_p(a.ctypes.data) for a in (keep, first, last, whole, scratch)]
    getattr(core(), name)(*arrays, *whole.shape)


@pytest.mark.parametrize(("n", "x", "m"), [(1, 2, 3), (2, 1, 1), (20, 3, 4)])
def test_a_linear_system_follows_its_recursion(n, x, m):
    keep, first, last = matrices(n, x, 1)
    forcing = np.random.default_rng(2).normal(size=(n, x, m))
    states = [np.zeros((x, m))]
    for k in range(n - 1):
        states.append(keep[k] @ states[-1] + first[k] @ forcing[k] + last[k] @ forcing[k + 1])
    run("core_run_linear", keep, first, last, forcing)
    np.testing.assert_allclose(forcing, states, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("n", "x"), [(1, 2), (2, 1), (15, 3)])
def test_its_adjoint_weighs_as_the_system_does(n, x):
    """For all f and s, the states of f weighted with s are f weighted with the adjoint of s."""
    keep, first, last = matrices(n, x, 3)
    forcing, source = np.random.default_rng(4).normal(size=(2, n, x, 1))
    states, weights = forcing.copy(), source.copy()
    run("core_run_linear", keep, first, last, states)
    run("core_run_adjoint", keep, first, last, weights)
    assert np.sum(states * source) == pytest.approx(np.sum(forcing * weights), rel=1e-10)
