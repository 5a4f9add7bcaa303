"""Effects that remember what was: a play before the model, and a sensor that lags its own past."""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from support.problems.driven_spring import driven, model_of
from support.simulated import Worker
from support.thinning import thinned
from support.truth.exact_linear import position
from support.truth.springs_with_effects import FORCE, START, TIMES, C, K, M, plain, solve

from workers.effects.signal_memory import SampledSignal, rate_limit
from workers.messages import Effect, Solver

EXACT = Solver("dormand_prince", rtol=1e-10)
CO_SIMULATION = Solver("fmu", step=0.002)


def simulated(effects, coefficients, solver, force=FORCE, interpolation="linear"):
    """Outputs of simulations of several points, a row of coefficients each."""
    run, points = driven(force=force, how=interpolation), [(M, K, C, *row) for row in coefficients]
    return [y[:, 0] for y in Worker(model_of(solver), run).outputs(*points, effects=effects)]


def behind_a_play(signal, half):
    """Moved only by contact: pushed at one end of the play or pulled at the other."""
    place, places = signal[0], []
    for s in signal:
        if s - place > half:
            place = s - half
        elif place - s > half:
            place = s + half
        places.append(place)
    return np.array(places)


FINE = 64


@cache
def played(half, gain=1.0):
    """The position behind a play that is followed in steps much finer than the samples."""
    times = np.linspace(TIMES[0], TIMES[-1], FINE * (len(TIMES) - 1) + 1)
    force = gain * behind_a_play(np.interp(times, TIMES, FORCE), half)
    return position(times, force, M, K, C, *START)[::FINE]


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
def test_backlash_at_an_input(solver):
    effect = Effect("e", "input F", "backlash")
    several = simulated([effect], [(0.7,), (0.0,), (2.5,)], solver)
    for half, found in zip((0.7, 0.0, 2.5), several, strict=True):
        np.testing.assert_allclose(found, played(half), atol=2e-6)
        sampled = solve(plain, force=behind_a_play(FORCE, half))[:, 0]
        if half > 0.0:  # the turns between the samples are seen
            assert np.abs(sampled - played(half)).max() > 1e-4


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
def test_backlash_at_an_output(solver):
    """A linkage with play, before a sensor that sees the position between the samples too."""
    effect = Effect("e", "output y", "backlash")
    plain_one, *several = simulated([effect], [(0.0,), (0.03,), (0.5,)], solver)
    fine = np.linspace(TIMES[0], TIMES[-1], FINE * (len(TIMES) - 1) + 1)
    truth = position(fine, np.interp(fine, TIMES, FORCE), M, K, C, *START)
    (unchanged,) = simulated([], [()], solver)
    assert plain_one.tobytes() == unchanged.tobytes()
    for half, found in zip((0.03, 0.5), several, strict=True):
        np.testing.assert_allclose(found, behind_a_play(truth, half)[::FINE], atol=6e-5)


def retraced(signal, x0):
    """What depends on the way of a signal alone: exact for straight lines."""
    z, states = 0.0, [0.0]
    for moved in (np.diff(signal) / x0).tolist():
        z = np.sign(moved) + (z - np.sign(moved)) * np.exp(-abs(moved))
        states.append(z)
    return np.array(states)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
@pytest.mark.parametrize("pace", [1.0, 2.5])
def test_hysteresis_of_an_actuator(solver, pace):
    """At any pace; a lag of a tenth of a sample makes an error of about a hundredth of it."""
    force = 2.0 * np.sin(pace * TIMES) + np.sin(2.7 * pace * TIMES)
    times = np.linspace(TIMES[0], TIMES[-1], FINE * (len(TIMES) - 1) + 1)
    given = np.interp(times, TIMES, force)
    acting = given - 0.8 * retraced(given, 1.5)
    unbent, truth = (position(times, each, M, K, C, *START)[::FINE] for each in (given, acting))
    effect = Effect("e", "input F", "hysteresis")
    tau = 0.1 * (TIMES[1] - TIMES[0])
    found, none = simulated([effect], [(-0.8, 1.5, tau), (0.0, 1.5, tau)], solver, force)
    (unchanged,) = simulated([], [()], solver, force)
    assert none.tobytes() == unchanged.tobytes()
    np.testing.assert_allclose(found, truth, atol=0.012 * np.abs(truth - unbent).max())


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION, Solver("rk4", step=0.001)])
@pytest.mark.parametrize("x0", [0.002, 1.0])
def test_hysteresis_goes_to_its_end_after_jumps_of_any_size(solver, x0):
    """With fixed steps too. The force is late by a lag of a tenth of a sample, and no more."""
    effect, acting = Effect("e", "input F", "hysteresis"), FORCE - 0.8 * retraced(FORCE, x0)
    tau = 0.1 * (TIMES[1] - TIMES[0])
    (found,) = simulated([effect], [(-0.8, x0, tau)], solver, interpolation="hold")
    (truth,) = simulated([], [()], solver, acting, "hold")
    (unbent,) = simulated([], [()], solver, interpolation="hold")
    np.testing.assert_allclose(found, truth, atol=0.1 * np.abs(truth - unbent).max())


def test_a_signal_is_changed_as_a_whole_before_it_is_bent():
    effects = [Effect("a", "input F", "gain"), Effect("b", "input F", "backlash")]
    (found,) = simulated(effects, [(0.2, 0.7)], EXACT)
    np.testing.assert_allclose(found, played(0.7, gain=1.2), atol=2e-6)


def limited(times, force, fastest, first):
    """Followed in small steps, each no larger than the rate allows."""
    out, most = [first], fastest * (times[1] - times[0])
    for target in force[1:].tolist():
        out.append(min(max(target, out[-1] - most), out[-1] + most))
    return np.array(out)


RATE_LIMITS = ("rate_limit", "rate_limit_from_rest")
RATES = (4.0, 25.0, 0.5)


@cache
def behind_a_limit(interpolation, from_rest):
    """The position without a limit, and those for each rate."""
    finer = 16 * FINE  # a step of the truth is as wrong as what the signal does in it
    times = np.linspace(TIMES[0], TIMES[-1], finer * (len(TIMES) - 1) + 1)
    force = np.interp(times, TIMES, FORCE)
    if interpolation == "hold":
        force = FORCE[np.searchsorted(TIMES, times + 1e-9, side="right") - 1]
    assert abs(force[0]) > 0.1
    forces = [limited(times, force, rate, 0.0 if from_rest else force[0]) for rate in RATES]
    return [position(times, each, M, K, C, *START)[::finer] for each in (force, *forces)]


@pytest.mark.parametrize(
    ("solver", "interpolation", "form"),
    thinned(
        [
            pytest.param(*case, marks=() if case[0] is EXACT else pytest.mark.slow)
            for case in product((EXACT, CO_SIMULATION), ("linear", "hold"), RATE_LIMITS)
        ],
        lambda solver, *_: solver,
    ),
)
def test_a_limited_rate_of_an_input(solver, interpolation, form):
    effect = Effect("e", "input F", form)
    several = simulated([effect], [(rate,) for rate in RATES], solver, FORCE, interpolation)
    unlimited, *truths = behind_a_limit(interpolation, form == "rate_limit_from_rest")
    for truth, found in zip(truths, several, strict=True):
        assert np.abs(truth - unlimited).max() > 1e-3
        np.testing.assert_allclose(found, truth, atol=6e-5)


def test_a_limited_rate_catches_up_after_the_last_sample():
    held = SampledSignal(np.array([0.0, 1.0]), np.array([0.0, 3.0]), "hold")
    found = rate_limit(held, 2.0)
    np.testing.assert_array_equal(found.times, [0.0, 1.0, 2.5])
    np.testing.assert_array_equal(found.values, [0.0, 0.0, 3.0])
    assert found.interpolation == "linear"
    line = SampledSignal(np.array([0.0, 1.0, 2.0]), np.array([0.0, 3.0, 3.0]))
    followed = rate_limit(line, 2.0)
    np.testing.assert_array_equal(followed.times, [0.0, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(followed.values, [0.0, 2.0, 3.0, 3.0])
    assert rate_limit(line, float("inf")) is line


def bristle(v, x0):
    """Exact for a signal that is linear between samples: each way of travel has its own end."""
    z, states = 0.0, [0.0]
    for a, b in pairwise(v):
        turn = a / (a - b) if a * b < 0.0 else 1.0  # the part of the step before v changes sign
        for area in (0.5 * turn * (a if turn < 1.0 else a + b), 0.5 * (1.0 - turn) * b):
            moved = 0.02 * area / x0
            z = np.sign(moved) + (z - np.sign(moved)) * np.exp(-abs(moved))
        states.append(z)
    return np.array(states)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
@pytest.mark.parametrize(("x0", "bar"), [(0.3, 3e-6), (0.002, 2e-4)])
def test_hysteresis_of_a_sensor(solver, x0, bar):
    """The kink at each turn costs accuracy, but however short x0 it stays stable."""
    force = 2.0 * np.sin(3.0 * TIMES)
    truth = solve(plain, force=force)[:, 0] + 0.02 * bristle(force, x0)
    effect = Effect("e", "output y", "hysteresis", ("F",))
    (found,) = simulated([effect], [(0.02, x0)], solver, force)
    np.testing.assert_allclose(found, truth, atol=bar)
