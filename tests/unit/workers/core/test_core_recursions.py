"""Memories and recursions of the core, against what defines them."""

import math
from ctypes import c_void_p

import numpy as np
import pytest

from workers.core.library import core
from workers.effects.signal_memory import MEMORIES, SampledSignal


def signals():
    """Linear and held ones, of equal and of unequal steps, some with jumps."""
    generator = np.random.default_rng(5)
    for n in (1, 2, 3, 40):
        for kind in ("linear", "hold"):
            times = np.cumsum(generator.uniform(0.01, 0.3, n))
            yield SampledSignal(times, np.round(generator.normal(size=n), 1), kind)
            yield SampledSignal(np.arange(n) * 0.1, np.sin(np.arange(n)), kind)


def sampled(signal, times):
    """A signal at any times."""
    if signal.interpolation == "linear":
        return np.interp(times, signal.times, signal.values)
    latest = np.searchsorted(signal.times, times, side="right") - 1
    return signal.values[np.maximum(latest, 0)]


def backlash_in_python(values, half_width):
    out = [values[0]]
    for value in values[1:]:
        out.append(min(max(out[-1], value - half_width), value + half_width))
    return out


@pytest.mark.parametrize("seconds", [0.0, 1e-17, 0.3, 50.0])
def test_a_delay_is_the_signal_of_some_time_ago(seconds):
    for signal in signals():
        found = MEMORIES["delay"](signal, seconds)
        assert found.interpolation == signal.interpolation
        assert (np.diff(found.times) > 0.0).all()
        between = np.linspace(signal.times[0], signal.times[-1], 57)[1:-1] + 1e-9
        expected = sampled(signal, between)
        assert sampled(found, between + seconds) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("half_width", [0.0, 1e-17, 0.3, 2.0])
def test_a_backlash_is_the_play_operator(half_width):
    for signal in signals():
        found = MEMORIES["backlash"](signal, half_width)
        assert found.interpolation == signal.interpolation
        assert (np.diff(found.times) > 0.0).all()
        kept = np.searchsorted(found.times, signal.times)
        np.testing.assert_array_equal(found.times[kept], signal.times)
        expected = backlash_in_python(signal.values, half_width)
        np.testing.assert_array_equal(found.values[kept], expected)
        fine = np.linspace(signal.times[0], signal.times[-1], 4001)
        if signal.interpolation == "linear":
            dense = backlash_in_python(np.interp(fine, *signal[:2]), half_width)
            np.testing.assert_allclose(np.interp(fine, *found[:2]), dense, atol=2e-2)


@pytest.mark.parametrize("fastest", [0.0, 1e-17, 0.3, 2.0, np.inf])
@pytest.mark.parametrize("name", ["rate_limit", "rate_limit_from_rest"])
def test_a_limited_rate_is_that_of_small_steps(name, fastest):
    """Against out' = clip(s', -r, r) where out = s, else r sign(s - out), in small steps."""
    for signal in signals():
        found = MEMORIES[name](signal, fastest)
        if math.isinf(fastest):
            assert found is signal
            continue
        assert found.interpolation == "linear"
        assert (np.diff(found.times) > 0.0).all()
        fine = np.linspace(signal.times[0], signal.times[-1], 4001)
        most = fastest * (fine[1] - fine[0])
        out = [signal.values[0] if name == "rate_limit" else 0.0]
        for value in sampled(signal, fine)[1:]:
            out.append(out[-1] + min(max(value - out[-1], -most), most))
        found_there = np.interp(fine, found.times, found.values)
        np.testing.assert_allclose(found_there, out, atol=5e-3)


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
