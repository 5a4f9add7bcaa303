"""Step responses of free filters, against SciPy on the equations of the forms."""

import numpy as np
import pytest
from scipy.signal import lsim

from cluster_est.results.shapes.step_responses import (
    dynamics_in_words,
    reduced_time_constants,
    settled_after,
    step_response,
)
from workers.effects.forms import FORMS
from workers.effects.laws import Law

FILTERS = {key: form for key, form in FORMS.items() if form.is_dynamics}
STRENGTHS, TAU = (0.8, -0.5, 0.6, 0.3, -0.2), 7.0


@pytest.mark.parametrize("key", FILTERS, ids=" ".join)
def test_a_step_response_is_that_of_the_equations(key):
    form = FILTERS[key]
    n = len(form.states)
    k = np.array(STRENGTHS[:n])
    values = np.array([*k, TAU, 1.0])
    t = np.linspace(0.0, settled_after(form, values), 400)
    direct = {Law.DYNAMICS: 0.0, Law.EXCHANGE: -k.sum(), Law.SIGNAL_DYNAMICS: 1.0 - k.sum()}
    lags = (np.eye(n, k=-1) - np.eye(n)) / TAU
    system = (lags, np.eye(n, 1) / TAU, k[None, :], [[direct[form.law]]])
    _, truth, _ = lsim(system, np.ones(len(t)), t)
    np.testing.assert_allclose(step_response(form)(t, values), truth, atol=1e-9)
    assert truth[-1] == pytest.approx(truth[0] + k.sum(), abs=1e-3)


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
