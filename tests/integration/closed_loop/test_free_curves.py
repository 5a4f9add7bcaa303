"""An effect of because the shape is not in the library is found as one curve, and drawn as one.

It has as many values as the data pay for, and stands for what several forms would patch.
"""

import numpy as np
import pytest
from support.problems.measured_springs import measured_springs
from support.truth.springs_with_effects import M, plain, pushed

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

KNOTS = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)
GAINED = (0.0, -0.9, 1.2, -0.4, -1.6, 0.8, 0.0)
"""What an amplifier adds: it goes up and down, as no power of the signal does."""
NOTCHES = {-0.12: 1.5, -0.02: -1.35, 0.09: 1.65}
WIDTH = 0.035


def bent(force):
    return np.interp(force, KNOTS, GAINED)


def detents(x):
    """Three notches in a rail: narrower than the steps of a coarse curve, and not periodic."""
    return sum(push * np.exp(-(((x - place) / WIDTH) ** 2)) for place, push in NOTCHES.items())


def closed(slope, swing, noise, seed, runs, sites, forms):
    """A loop on springs whose mass is known, or all could be in proportion to a gain."""
    problem = measured_springs(
        slope,
        ce.Parameter("m", M, fixed=True),
        swing=swing,
        noise=noise,
        random=np.random.default_rng(seed),
        roles=("train",) * (runs - 1) + ("test",),
    )
    settings = ce.LoopSettings(sites=sites, forms=forms, pairs=False)
    return ce.close_loop(problem, settings=settings)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((("input F",), ("characteristic", "gain", "cubic")), id="few forms"),
        pytest.param(
            (("input F", "der(v)", "output y"), ()), id="all forms", marks=pytest.mark.slow
        ),
    ],
)
def amplifier(request):
    return closed(lambda t, x, f: plain(t, x, f + bent(f)), 6.0, 5e-3, 11, 4, *request.param)


def test_a_curve_is_found_at_its_place(amplifier):
    """The mass is known and the force acts on it alone, so two places say the same."""
    assert amplifier.verdict in (Verdict.FOUND, Verdict.PARTIAL)  # it bends between its knots
    (effect,) = amplifier.effects
    place = (effect.site, effect.form.partition("_")[0], effect.variables)
    assert place in (("input F", "characteristic", ()), ("der(v)", "table", ("F",)))
    assert "table of F from low to high: k" in effect.equation
    assert "criterion falls by" in effect.evidence[0]
    assert "because the shape is not in the library" in amplifier.message
    assert amplifier.rms("test", "before") > 10.0
    assert amplifier.rms("test", "after") < 1.5


def added(result, x, y):
    """What is added to the force, in its unit."""
    (effect,) = result.effects
    return y - x if effect.site == "input F" else M * y


def test_it_is_drawn_beside_what_the_residuals_ask_for(amplifier):
    (curve,) = amplifier.curves
    for x, y, near in ((curve.x, curve.y, 0.4), (curve.free_x, curve.free_y, 0.5)):
        inside = np.abs(x) < 5.0
        np.testing.assert_allclose(added(amplifier, x, y)[inside], bent(x)[inside], atol=near)
    assert len(curve.free_x) == len(curve.free_error) > 5
    assert np.all(curve.free_error > 0.0)


def straightened(x, y):
    """A curve without the straight line that the spring's stiffness may have as well."""
    return y - np.polyval(np.polyfit(x, y, 1), x)


@pytest.mark.slow
def test_narrow_notches_are_one_fine_curve_that_is_drawn_and_stands_in_the_findings():
    slope = pushed(lambda t, x, force: detents(x[0]))
    rail = closed(slope, 3.0, 2e-3, 3, 7, ("der(v)", "output y"), ())
    # simulations with bends are noisy, so the last fit does not converge on every processor
    assert rail.verdict in (Verdict.FOUND, Verdict.PARTIAL)
    (effect,) = rail.effects
    assert (effect.site, effect.variables) == ("der(v)", ("x",))
    assert effect.form in ("table_13", "table_25")
    assert " ..., k" in effect.equation
    assert rail.rms("test", "before") > 5.0
    assert rail.rms("test", "after") < 1.5
    (curve,) = rail.curves
    inside = (curve.x > -0.2) & (curve.x < 0.2)
    found, truth = (straightened(curve.x[inside], y[inside]) for y in (curve.y, detents(curve.x)))
    assert np.corrcoef(found, truth)[0, 1] > 0.97
    rows = rail.table("findings").to_pylist()
    accepted = [(row["site"], row["form"]) for row in rows if row["stage"] == "accepted"]
    assert (effect.site, effect.form) in accepted
