"""A curve has as many values as the data pay for, and one curve stands for what several patch."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.measured_springs import measured_springs
from support.truth.springs_with_effects import M, pushed

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.settings import LoopSettings

PLACES = (-0.12, -0.02, 0.09)
PUSHES = (1.5, -1.35, 1.65)
WIDTH = 0.035


def detents(x):
    """Three notches in a rail: narrower than the steps of a coarse curve, and not periodic."""
    return sum(
        push * np.exp(-(((x - place) / WIDTH) ** 2))
        for place, push in zip(PLACES, PUSHES, strict=True)
    )


@pytest.fixture(scope="module")
def result():
    problem = measured_springs(
        pushed(lambda t, x, force: detents(x[0])),
        ce.Parameter("m", M, fixed=True),
        swing=3.0,
        noise=2e-3,
        random=np.random.default_rng(3),
        roles=("train",) * 6 + ("test",),
    )
    settings = LoopSettings(sites=("der(v)", "output y"), pairs=False)
    return ce.close_loop(problem, settings=settings)


def test_it_is_one_fine_curve_of_the_right_argument_at_the_right_site(result):
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    assert (effect.site, effect.variables) == ("der(v)", ("x",))
    assert effect.form in ("table_13", "table_25")
    assert " ..., k" in effect.equation


def test_what_was_held_out_is_predicted(result):
    assert result.rms("test", "before") > 5.0
    assert result.rms("test", "after") < 1.5


def test_it_is_drawn(result):
    (curve,) = result.curves
    inside = (curve.x > -0.2) & (curve.x < 0.2)
    found, truth = (_bent(curve.x[inside], y[inside]) for y in (curve.y, detents(curve.x)))
    assert np.corrcoef(found, truth)[0, 1] > 0.97


def _bent(x, y):
    """A curve without the straight line that the spring's stiffness may have as well."""
    return y - np.polyval(np.polyfit(x, y, 1), x)


def test_the_candidates_say_how_far_it_came(result):
    rows = result.table("findings").to_pylist()
    accepted = [(row["site"], row["form"]) for row in rows if row["stage"] == "accepted"]
    (effect,) = result.effects
    assert (effect.site, effect.form) in accepted
