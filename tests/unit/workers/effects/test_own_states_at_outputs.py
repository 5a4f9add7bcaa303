"""Own states of effects at outputs follow what was recorded, however fast they are.

The truth is the solution from one time to the next, between which everything is a line, or the
quasi-steady one by hand: far behind its start, a lag tau of a ramp with slope c is late by
c tau. Where records are dense the output between them is known, and not taken for a line.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from support.problems.springs import FMU

from workers.effects.definition import EffectDefinition, define
from workers.effects.outputs import apply_output_effect
from workers.fmu.description import describe_model
from workers.grid import build_grid
from workers.messages import Effect, Experiment, FloatArray, Input, Model, Solver

MODEL = Model("spring", FMU.read_bytes(), "model_exchange", Solver("rk4"), ())
UNEVEN = np.concatenate([np.linspace(0.0, 1.0, 41), 1.0 + np.cumsum([0.02, 10.0, 0.1, 0.1, 7.0])])
"""Dense, and with gaps of hundreds of time constants."""
TRUE_TIMES = np.concatenate([np.linspace(0.0, 1.0, 4001), UNEVEN[41:]])
"""The dense part as finely as it is known."""


def defined(form: str, variables: tuple[str, ...] = ()) -> EffectDefinition:
    effect = Effect("e", "output y", form, variables)
    return define(effect, describe_model(MODEL), "model_exchange")


def shown(definition: EffectDefinition, values: list[float], times: FloatArray) -> FloatArray:
    """The output with the effect, from y = sin t and the input F = cos 2 t."""
    outputs = np.sin(times)[:, None].copy()
    force = Input("F", times, np.cos(2.0 * times))
    signals = build_grid(Experiment("e", times[0], times[-1], (force,), ()))
    apply_output_effect(definition, np.array(values), signals, outputs, ("y",), ("F",))
    return outputs[:, 0]


def followed(times: FloatArray, signal: FloatArray, start: float, tau: float) -> FloatArray:
    """z' = (signal - z) / tau, exactly, from time to time, between which the signal is a line."""
    z = [start]
    for (a, b), (one, other) in zip(pairwise(times), pairwise(signal), strict=True):
        slope = (other - one) / (b - a)
        late = z[-1] - one + tau * slope
        z.append(other - tau * slope + late * np.exp(-(b - a) / tau))
    return np.array(z)


@pytest.mark.parametrize("tau", [3.0, 0.3, 0.02])
def test_a_lag_follows_what_was_between_recorded_times(tau):
    expected = followed(TRUE_TIMES, np.sin(TRUE_TIMES), 0.0, tau)
    expected = expected[np.searchsorted(TRUE_TIMES, UNEVEN - 1e-9)]
    found = shown(defined("lag"), [tau], UNEVEN)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    straight = followed(UNEVEN, np.sin(UNEVEN), 0.0, tau)
    wrong, before = (np.abs(z - expected)[1:41].max() for z in (found, straight))
    assert wrong < 0.1 * before


@pytest.mark.parametrize("tau", [0.3, 0.02])
def test_a_lag_of_an_input_too(tau):
    force = followed(UNEVEN, np.cos(2.0 * UNEVEN), 0.0, tau)
    found = shown(defined("lagged_feed_through", ("F",)), [0.7, tau], UNEVEN)
    np.testing.assert_allclose(found, np.sin(UNEVEN) + 0.7 * force, atol=1e-8)


@pytest.mark.parametrize("tau", [1e-3, 1e-6, 1e-12])
def test_a_very_fast_one_is_late_by_its_time_constant(tau):
    slopes = np.diff(np.sin(UNEVEN)) / np.diff(UNEVEN)
    slopes[:40] = np.cos(UNEVEN[1:41])
    expected = np.sin(UNEVEN)[1:] - tau * slopes
    found = shown(defined("lag"), [tau], UNEVEN)
    np.testing.assert_allclose(found[1:], expected, atol=3e-3 * tau + 1e-15)


def two_followed(times: FloatArray, signal: FloatArray, f: float, d: float) -> FloatArray:
    """z' = f y, y' = f (signal - z) - 2 d f y, from rest at the signal, by the matrix exponential.

    The signal and its slope are states beside them.
    """
    system = np.zeros((4, 4))
    system[0, 1], system[1, :3], system[2, 3] = f, [-f, -2.0 * d * f, f], 1.0
    x, z = np.array([signal[0], 0.0]), [signal[0]]
    for (a, b), (one, other) in zip(pairwise(times), pairwise(signal), strict=True):
        x = (expm(system * (b - a)) @ [*x, one, (other - one) / (b - a)])[:2]
        z.append(x[0])
    return np.array(z)


@pytest.mark.parametrize(("f", "d"), [(3.0, 0.2), (300.0, 1.0), (1e3, 8.0), (1e7, 0.7)])
def test_two_that_swing_follow_exactly(f, d):
    """However fast one of them is, which substeps would follow in thousands."""
    dense, fine = UNEVEN[:41], TRUE_TIMES[:4001:12]
    fine = np.union1d(fine, dense)
    expected = two_followed(fine, np.sin(fine), f, d)[np.searchsorted(fine, dense - 1e-9)]
    np.testing.assert_allclose(shown(defined("mode"), [f, d], dense), expected, atol=3e-6)


def test_two_that_swing_on_lines_are_exact():
    times = np.cumsum([0.0, 0.5, 30.0, 0.4, 20.0, 0.3])
    found = shown(defined("mode"), [40.0, 3.0], times)
    np.testing.assert_allclose(found, two_followed(times, np.sin(times), 40.0, 3.0), atol=1e-10)


def test_a_slow_one_keeps_its_digits():
    """Where the exponent is small, differences of exponentials would lose them."""
    tau = 1e7
    times = np.linspace(0.0, 1.0, 11)
    expected = (1.0 - np.cos(times)) / tau
    np.testing.assert_allclose(shown(defined("lag"), [tau], times), expected, rtol=1e-4)
