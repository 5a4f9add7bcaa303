"""Forms as functions over signals, against their equations written down again and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cluster_est.closed_loop.candidates.shapes import FormArguments, shape_of
from workers.effects.forms import FORMS

T = np.linspace(0.0, 4.0, 401)
S = 1.5 * np.sin(2.0 * T) + 0.2
V = np.cos(3.0 * T) + 0.1 * T
W = np.sin(5.0 * T + 1.0)
SIGNALS = FormArguments(T, S, V, W)
HATS = [np.interp(V, np.linspace(-0.9, 1.1, 7), np.eye(7)[i]) for i in range(7)]
HATS_OF_W = [np.interp(W, np.linspace(-0.9, 1.1, 7), np.eye(7)[i]) for i in range(7)]
HATS_OF_S = [np.interp(S, np.linspace(-0.9, 1.1, 7), np.eye(7)[i]) for i in range(7)]
OUTER = np.maximum(V - 0.4, 0) - np.maximum(-V - 0.4, 0)
SIGNED = np.sign(V) * np.sqrt(np.abs(V))

LINEAR = {
    ("derivative", "constant"): ([0], [np.ones(401)]),
    ("derivative", "drift"): ([0], [T]),
    ("derivative", "sine"): ([0, 0, 7.0], [np.sin(7 * T), np.cos(7 * T)]),
    ("derivative", "periodic"): ([0, 0, 7.0], [np.sin(7 * V), np.cos(7 * V)]),
    ("derivative", "viscous"): ([0], [-V]),
    ("derivative", "quadratic"): ([0], [-V * np.abs(V)]),
    ("derivative", "cubic"): ([0], [-(V**3)]),
    ("derivative", "power"): ([0, 1.4, 0.9], [-np.sign(V) * (np.abs(V) / 0.9) ** 1.4]),
    ("derivative", "radiation"): ([0, 0.3], [-((V + 0.3) ** 4) + (W + 0.3) ** 4]),
    ("derivative", "exponential"): ([0, 0.9, 0.4], [np.exp((V - 0.9) / 0.4)]),
    ("derivative", "contact"): ([0, 0.4, 1.5, 0.9], [(np.maximum(V - 0.4, 0) / 0.9) ** 1.5]),
    ("derivative", "coulomb"): ([0, 0.1], [-np.tanh(V / 0.1)]),
    ("derivative", "stribeck"): (
        [0, 0, 0.3, 0.1],
        [-np.tanh(V / 0.1), -np.exp(-((V / 0.3) ** 2)) * np.tanh(V / 0.1)],
    ),
    ("derivative", "asymmetric_coulomb"): (
        [0, 0, 0.1],
        [-np.tanh(V / 0.1) * (V > 0), -np.tanh(V / 0.1) * (V < 0)],
    ),
    ("derivative", "load_dependent_coulomb"): ([0, 0.1], [-np.abs(W) * np.tanh(V / 0.1)]),
    ("derivative", "linear"): ([0], [V]),
    ("derivative", "saturating"): ([0, 0.4], [V / (0.4 + np.abs(V))]),
    ("derivative", "square"): ([0], [V**2]),
    ("derivative", "product"): ([0], [V * W]),
    ("derivative", "hinge"): ([0, 0.4], [np.maximum(V - 0.4, 0)]),
    ("derivative", "hinge_below"): ([0, 0.4], [np.maximum(0.4 - V, 0)]),
    ("derivative", "gap"): ([0, 0.4], [-OUTER]),
    ("derivative", "square_root"): ([0], [-np.sqrt(np.maximum(V, 0))]),
    ("derivative", "signed_root"): ([0], [-SIGNED]),
    ("derivative", "coulomb_table"): (
        [0] * 7 + [-0.9, 1.1, 0.1],
        [-hat * np.tanh(V / 0.1) for hat in HATS_OF_W],
    ),
    ("derivative", "table"): ([0] * 7 + [-0.9, 1.1], HATS),
    ("pair", "joint"): ([0, 0, 0.4], [-np.clip(V, -0.4, 0.4), np.clip(V, -0.4, 0.4)]),
    ("pair", "gap"): ([0, 0, 0.4], [-OUTER, OUTER]),
    ("pair", "overflow"): ([0, 0, 0.4], [-np.maximum(V - 0.4, 0), np.maximum(V - 0.4, 0)]),
    ("pair", "hinge"): ([0, 0, 0.4], [-np.maximum(V - 0.4, 0), np.maximum(V - 0.4, 0)]),
    ("pair", "hinge_below"): ([0, 0, 0.4], [np.maximum(0.4 - V, 0), -np.maximum(0.4 - V, 0)]),
    ("pair", "linear"): ([0, 0], [-V, V]),
    ("pair", "quadratic"): ([0, 0], [-V * np.abs(V), V * np.abs(V)]),
    ("pair", "cubic"): ([0, 0], [-(V**3), V**3]),
    ("pair", "coulomb"): ([0, 0, 0.1], [-np.tanh(V / 0.1), np.tanh(V / 0.1)]),
    ("pair", "leak"): ([0, 0], [-SIGNED, SIGNED]),
    ("pair", "table"): ([0] * 7 + [0.5, -0.9, 1.1], HATS),
    ("input", "bias"): ([0], [np.ones(401)]),
    ("input", "drift"): ([0], [T]),
    ("input", "gain"): ([0], [S]),
    ("input", "square"): ([0], [S**2]),
    ("input", "cubic"): ([0], [S**3]),
    ("input", "asymmetry"): ([0], [np.maximum(S, 0)]),
    ("input", "product"): ([0], [S * V]),
    ("input", "table"): ([0] * 7 + [-0.9, 1.1], HATS),
    ("input", "characteristic"): ([0] * 5 + [-0.9, 1.1], HATS_OF_S[1:-1]),
    ("output", "characteristic"): ([0] * 5 + [-0.9, 1.1], HATS_OF_S[1:-1]),
    ("output", "bias"): ([0], [np.ones(401)]),
    ("output", "drift"): ([0], [T]),
    ("output", "gain"): ([0], [S]),
    ("output", "square"): ([0], [S**2]),
    ("output", "cubic"): ([0], [S**3]),
    ("output", "absolute"): ([0], [np.abs(S)]),
    ("output", "feed_through"): ([0], [V]),
    ("output", "hum"): ([0, 0, 7.0], [np.sin(7 * T), np.cos(7 * T)]),
    ("parameter", "drift"): ([0, 2.0], [S * (T - 2)]),
    ("parameter", "sine"): ([0, 0, 7.0], [S * np.sin(7 * T), S * np.cos(7 * T)]),
    ("parameter", "linear"): ([0, 0.3], [S * (V - 0.3)]),
    ("parameter", "magnitude"): ([0, 0.3], [S * (np.abs(V) - 0.3)]),
    ("parameter", "saturating"): ([0, 0.4], [-S * np.abs(V) / (0.4 + np.abs(V))]),
    ("parameter", "table"): (
        [0, 0, 0, 0, 0, 0, -0.9, 1.1],
        [S * HATS[i] for i in (0, 1, 2, 4, 5, 6)],
    ),
    ("parameter", "square"): ([0, 0.3], [S * (V**2 - 0.3)]),
}
FINITE = {
    ("input", "dead_zone"): ([0.5], np.where(np.abs(S) > 0.5, -0.5 * np.sign(S), -S)),
    ("input", "saturation"): ([0.9], np.clip(S, -0.9, 0.9) - S),
    ("output", "saturation"): ([0.9], np.clip(S, -0.9, 0.9) - S),
    ("output", "clip_above"): ([0.9], np.minimum(S, 0.9) - S),
    ("output", "clip_below"): ([-0.9], np.maximum(S, -0.9) - S),
    ("input", "delay"): ([0.2], np.interp(T - 0.2, T, S) - S),
    ("output", "delay"): ([0.2], np.interp(T - 0.2, T, S) - S),
}


def of(key, values):
    form = FORMS[key]
    names = [c.name for c in form.coefficients]
    return shape_of(form).directions(SIGNALS, dict(zip(names, values, strict=True)))


@pytest.mark.parametrize("key", LINEAR)
def test_what_is_added_per_unit_of_each_strength(key):
    values, expected = LINEAR[key]
    np.testing.assert_allclose(of(key, values), np.column_stack(expected), atol=1e-12)


@pytest.mark.parametrize("key", FINITE)
def test_the_whole_change_of_what_is_linear_in_nothing(key):
    values, expected = FINITE[key]
    assert shape_of(FORMS[key]).strengths == ()
    np.testing.assert_allclose(of(key, values), expected[:, None], atol=1e-12)


def test_backlash_is_the_play_operator():
    expected, out = [], S[0]
    for s in S:
        out = min(max(out, s - 0.3), s + 0.3)
        expected.append(out - s)
    np.testing.assert_allclose(of(("input", "backlash"), [0.3])[:, 0], expected, atol=1e-12)


def followed(slope, start):
    run = solve_ivp(slope, (0.0, 4.0), [start], t_eval=T, rtol=1e-10, atol=1e-12, max_step=0.01)
    return run.y[0]


def v_at(t):
    return np.cos(3.0 * t) + 0.1 * t


def s_at(t):
    return 1.5 * np.sin(2.0 * t) + 0.2


BRISTLE = followed(lambda t, z: (v_at(t) - abs(v_at(t)) * z) / 0.1, 0.0)
OWN_STATES = {
    ("derivative", "dahl"): ([0, 0.1], -BRISTLE),
    ("output", "hysteresis"): ([0, 0.1], BRISTLE),
    ("derivative", "lagged"): ([0, 0.7], followed(lambda t, z: (v_at(t) - z) / 0.7, V[0])),
    ("output", "lagged_feed_through"): (
        [0, 0.05],
        followed(lambda t, z: (v_at(t) - z) / 0.05, 0.0),
    ),
    ("parameter", "heating"): (
        [0, 0.3, 0.7],
        S * (followed(lambda t, z: (v_at(t) ** 2 - z) / 0.7, 0.0) - 0.3),
    ),
    ("input", "lag"): ([0.2], followed(lambda t, z: (s_at(t) - z) / 0.2, S[0]) - S),
    ("output", "lag"): ([0.2], followed(lambda t, z: (s_at(t) - z) / 0.2, S[0]) - S),
}


@pytest.mark.parametrize("key", OWN_STATES)
def test_own_states_follow_their_differential_equations(key):
    """To the error of signals that are linear between 100 samples a second."""
    values, expected = OWN_STATES[key]
    np.testing.assert_allclose(of(key, values)[:, 0], expected, atol=2e-3 * np.ptp(expected))


def test_a_time_constant_far_below_the_sampling_follows_the_signal():
    np.testing.assert_allclose(of(("derivative", "lagged"), [0, 1e-7])[1:, 0], V[1:], atol=1e-4)


def test_a_strength_is_what_the_equation_is_linear_in_and_neutral_at_zero():
    for form in FORMS.values():
        neutral = {c.name for c in form.coefficients if c.neutral == 0.0 and not c.scale}
        assert set(shape_of(form).strengths) == neutral, form.name


def test_a_curve_between_two_states_acts_on_the_second_in_proportion():
    form = FORMS["pair", "table"]
    values = dict(zip((c.name for c in form.coefficients), [0] * 7 + [0.5, -0.9, 1.1], strict=True))
    shape = shape_of(form)
    assert shape.mirrored
    expected = -0.5 * np.column_stack(HATS)
    np.testing.assert_allclose(shape.reactions(SIGNALS, values), expected, atol=1e-12)


def test_no_other_form_has_a_strength_that_acts_on_both():
    mirrored = {key for key, form in FORMS.items() if shape_of(form).mirrored}
    assert mirrored == {("pair", name) for name in ("table", "table_13", "table_25")}
