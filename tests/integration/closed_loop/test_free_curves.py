"""An effect of a shape that no form of the library has is found as a curve, and drawn as one."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.measured_springs import measured_springs
from support.truth.springs_with_effects import M, plain

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.settings import LoopSettings

KNOTS = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)
GAINED = (0.0, -0.9, 1.2, -0.4, -1.6, 0.8, 0.0)
"""What an amplifier adds: it goes up and down, as no power of the signal does."""
PLACES = (("input F", "characteristic", ()), ("der(v)", "table", ("F",)))
"""The mass is known and the force acts on it alone, so both say the same."""


def bent(force):
    return force + np.interp(force, KNOTS, GAINED)


@pytest.fixture(scope="module")
def result():
    problem = measured_springs(
        lambda t, x, f: plain(t, x, bent(f)),
        ce.Parameter("m", M, fixed=True),  # or all parameters could be in proportion to the gain
        swing=6.0,
        noise=5e-3,
        random=np.random.default_rng(11),
        roles=("train", "train", "train", "test"),
    )
    settings = LoopSettings(sites=("input F", "der(v)", "output y"), pairs=False)
    return ce.close_loop(problem, settings=settings)


def test_it_is_found_as_a_curve(result):
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    place = (effect.site, effect.form.partition("_")[0], effect.variables)
    assert place in PLACES
    assert "table of F from low to high: k" in effect.equation
    assert "criterion falls by" in effect.evidence[0]
    assert "a shape that no form of the library has" in result.summary


def test_what_was_held_out_is_predicted(result):
    assert result.rms("test", "before") > 10.0
    assert result.rms("test", "after") < 1.5


def test_it_is_drawn(result):
    (curve,) = result.curves
    inside = (curve.x > -5.0) & (curve.x < 5.0)
    (effect,) = result.effects
    rise = curve.y - curve.x if effect.site == "input F" else M * curve.y
    np.testing.assert_allclose(rise[inside], np.interp(curve.x, KNOTS, GAINED)[inside], atol=0.4)
