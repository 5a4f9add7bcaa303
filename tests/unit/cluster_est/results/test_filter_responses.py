"""Responses of free filters, against SciPy on the equations of the forms."""

import numpy as np
import pytest
from scipy.signal import freqs, lsim

from cluster_est.results.shapes.effect_shapes import spread_of
from cluster_est.results.shapes.filter_responses import (
    bode_plot,
    dynamics_in_words,
    reduced_time_constants,
    settled_after,
    shown_frequencies,
    step_response,
)
from workers.effects.forms import FORMS
from workers.effects.laws import Law
from workers.messages import Experiment, Output

FILTERS = {key: form for key, form in FORMS.items() if form.is_dynamics}
STRENGTHS, TAU = (0.8, -0.5, 0.6, 0.3, -0.2), 7.0


def values_and_system(form, sign=1.0):
    """The coefficients of a filter, and its state space."""
    n = len(form.states)
    k = sign * np.array(STRENGTHS[:n])
    direct = {Law.DYNAMICS: 0.0, Law.EXCHANGE: -k.sum(), Law.SIGNAL_DYNAMICS: 1.0 - k.sum()}
    lags = (np.eye(n, k=-1) - np.eye(n)) / TAU
    system = (lags, np.eye(n, 1) / TAU, k[None, :], [[direct[form.law]]])
    return np.array([*k, TAU, 1.0]), system


@pytest.mark.parametrize("key", FILTERS, ids=" ".join)
def test_a_step_response_is_that_of_the_equations(key):
    form = FILTERS[key]
    values, system = values_and_system(form)
    t = np.linspace(0.0, settled_after(form, values), 400)
    _, truth, _ = lsim(system, np.ones(len(t)), t)
    np.testing.assert_allclose(step_response(form)(t, values), truth, atol=1e-9)
    assert truth[-1] == pytest.approx(truth[0] + system[2].sum(), abs=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("key", FILTERS, ids=" ".join)
def test_magnitude_and_phase_are_those_of_the_equations(key, sign):
    form, f = FILTERS[key], np.geomspace(1e-4, 10.0, 300)
    values, (_, _, (k,), ((direct,),)) = values_and_system(form, sign)
    lag, n = np.poly1d([TAU, 1.0]), len(k)
    numerator = lag**n * direct + sum(lag ** (n - 1 - i) * k[i] for i in range(n))
    _, truth = freqs(numerator.coeffs, (lag**n).coeffs, 2.0 * np.pi * f)
    magnitude, phase = (response(f, values) for response in bode_plot(form))
    np.testing.assert_allclose(10.0 ** (magnitude / 20.0), np.abs(truth), rtol=1e-9)
    np.testing.assert_allclose(np.exp(1j * np.radians(phase)), truth / np.abs(truth), atol=1e-7)
    assert np.abs(np.diff(phase)).max() < 90.0


def test_the_band_of_a_bode_plot_is_that_of_the_gain_and_of_the_lag():
    """H = k / (1 + 2 pi j f tau), so log |H| moves with k, and the phase with tau alone."""
    magnitude, phase = bode_plot(FORMS["output", "hidden_dynamics"])
    f = np.geomspace(1e-3, 1.0, 50)
    values = np.array([2.0, 0.0, 0.0, TAU, 1.0])
    of_k, of_tau = np.diag([0.04, 0.0, 0.0, 0.0, 0.0]), np.diag([0.0, 0.0, 0.0, 0.25, 0.0])
    decibels = 20.0 / np.log(10.0) * 0.2 / 2.0
    np.testing.assert_allclose(spread_of(magnitude, f, values, of_k), decibels, rtol=1e-6)
    np.testing.assert_allclose(spread_of(phase, f, values, of_k), 0.0, atol=1e-6)
    slope = 2.0 * np.pi * f / (1.0 + (2.0 * np.pi * f * TAU) ** 2)
    np.testing.assert_allclose(
        spread_of(phase, f, values, of_tau), np.degrees(slope) * 0.5, rtol=1e-6
    )


@pytest.mark.parametrize(
    ("stop", "samples", "shown"),
    [
        (100.0, 10_000, (0.1, 10.0)),  # a decade on both sides of the corner
        (20.0, 100, (0.1, 2.5)),
        (5.0, 1_000, (0.2, 10.0)),
        (0.01, 10, (0.1, 10.0)),  # a record that shows nothing of the filter
    ],
)
def test_a_bode_plot_goes_as_far_as_the_data_and_the_filter(stop, samples, shown):
    times = np.linspace(0.0, stop, samples)
    run = Experiment("run", 0.0, stop, (), (Output("y", times, times, 1.0),))
    corner_at_1_hz = np.array([1.0, 0.0, 0.0, 0.5 / np.pi, 1.0])
    found = shown_frequencies(FORMS["derivative", "hidden_dynamics"], corner_at_1_hz, [run])
    assert found == pytest.approx(shown)


@pytest.mark.parametrize(
    ("strengths", "said"),
    [
        (
            (2.0, 0.0, 0.0),
            "the step response reaches 63 % after 40 s; a model with the time constant 40 s has "
            "nearly the same response",
        ),
        (
            (0.0, -3.0, 0.0),
            "the step response reaches 63 % after 85.9 s; a model with the time constants 40 s and "
            "40 s has nearly the same response",
        ),
        ((0.0, 0.0, 1.0), "the step response reaches 63 % after 2.17 min"),
        ((1.0, -2.0, 1.0), "the step response returns to its initial value"),
        ((0.0, 0.0, 0.0), ""),
        ((np.nan, 1.0, 1.0), ""),
    ],
)
def test_a_step_response_in_words(strengths, said):
    """1 - exp(-x) (1 + x) is 0.632 at 2.146, and one lag more at 3.257."""
    form = FORMS["derivative", "hidden_dynamics"]
    assert dynamics_in_words(form, (*strengths, 40.0, 1.0)) == said


def test_two_lags_apart_are_known_from_a_filter_that_follows_them():
    """A filter of equal lags that was fitted to two lags of 10 and 30 seconds."""
    t, lags = np.linspace(0.0, 300.0, 600), np.eye(5, k=-1) - np.eye(5)
    truth = 1.0 + 0.5 * np.exp(-t / 10.0) - 1.5 * np.exp(-t / 30.0)
    parts = lsim((lags / 20.0, np.eye(5, 1) / 20.0, np.eye(5), np.zeros((5, 1))), np.ones(600), t)[
        1
    ]
    strengths = np.linalg.lstsq(parts, truth, rcond=None)[0]
    np.testing.assert_allclose(reduced_time_constants(strengths, 20.0), (10.0, 30.0), rtol=0.1)
