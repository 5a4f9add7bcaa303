"""What the data say about where coefficients could lie."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.closed_loop.candidates.scales import SignalScales, oscillates
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from workers.effects.forms import FORMS, FormCoefficient, GridScale
from workers.effects.site import EffectSite

T = np.linspace(0.0, 10.0, 2001)
RATE = 2.0 * np.pi
DER, OUT = EffectSite("derivative", "v"), EffectSite("output", "y")


def course(times=T, **signals):
    zeros = np.zeros(len(times))
    columns = {name: np.broadcast_to(s, len(times)) for name, s in signals.items()}
    return LinearisedTrajectory(times, columns, zeros[:, None], ("y",), None, np.zeros(0, int),
                  np.zeros(0, int), np.zeros(0))  # fmt: skip


SWING = 3.0 * np.sin(RATE * T)
SCALES = SignalScales([course(v=SWING, y=SWING + 1.0), course(v=SWING, y=SWING + 1.0)], (2.5, 7.0))


def grid(scale, *entries, site=DER):
    return SCALES.grid(
        FormCoefficient("c", None, scale=GridScale(scale), grid=entries), site, ("v",)
    )


@pytest.mark.parametrize(
    ("scale", "entry", "expected"),
    [
        ("rms v", 2.0, 2.0 * 3.0 / np.sqrt(2.0)),
        ("max v", 0.5, 1.5),
        ("quantile v", 0.75, 3.0 * np.sin(np.pi / 4)),
        ("mean v", 1.0, 0.0),
        ("mean |v|", 1.0, 6.0 / np.pi),
        ("mean v^2", 1.0, 4.5),
        ("travel v", 1.0, 3.0 / RATE / np.sqrt(2.0)),
        ("low v", 1.0, -3.0 * np.cos(0.01 * np.pi)),
        ("high v", 1.0, 3.0 * np.cos(0.01 * np.pi)),
        ("step", 4.0, 0.02),
        ("middle t", 1.0, 5.0),
    ],
)
def test_scales_of_a_sine(scale, entry, expected):
    assert grid(scale, entry) == pytest.approx((expected,), abs=2e-2)


def test_times_are_multiples_of_a_longer_communication_step():
    scales = SignalScales([course(v=SWING)], (), communication=0.05)
    found = scales.grid(FormCoefficient("tau", scale=GridScale("step"), grid=(4.0,)), DER, ("v",))
    assert scales.resolution == 0.05
    assert found == pytest.approx((0.2,))
    assert SCALES.resolution == pytest.approx(0.005)


@pytest.mark.parametrize(("step", "moved"), [(np.inf, 1.0), (0.005, 1.0), (0.001, 0.2)])
def test_a_switch_is_no_narrower_than_what_a_fixed_step_goes_across(step, moved):
    """|v'| = 3 RATE |cos| has the median 3 RATE / sqrt(2); an interval is 0.005 s."""
    width = FORMS["derivative", "coulomb"].coefficients[-1]
    assert width.name == "width"
    scales = SignalScales([course(v=SWING)], (), step=step)
    crossed = moved * 0.005 * 3.0 * RATE / np.sqrt(2.0)
    rms = 3.0 / np.sqrt(2.0)
    found = scales.grid(width, DER, ("v",))
    expected = dict.fromkeys(max(share * rms, crossed) for share in width.grid)
    assert found == pytest.approx(tuple(expected), rel=1e-2)
    assert SCALES.grid(width, DER, ("v",)) == pytest.approx([s * rms for s in width.grid], rel=1e-2)


def test_scales_of_the_signal_at_the_site():
    assert grid("range s", 0.25, 1.0, site=OUT) == pytest.approx((-0.5, 4.0))
    assert grid("max s", 0.5, site=OUT) == pytest.approx((2.0,))
    assert grid("max s", 0.5) == ()
    assert grid("spectrum", 1.0) == (2.5, 7.0)


@pytest.mark.parametrize(
    ("signal", "expected"),
    [(SWING, True), (SWING + 2.9, False), (np.abs(SWING), False), (0.0 * T, False)],
)
def test_a_signal_oscillates_if_it_clearly_takes_both_signs(signal, expected):
    assert oscillates(signal) is expected


@pytest.mark.parametrize(
    ("form", "signal", "expected"),
    [
        ("linear", SWING, True),
        ("linear", 5.0, False),
        ("linear", 0.0, False),
        ("coulomb", SWING, True),
        ("coulomb", SWING + 4.0, False),
        ("square_root", SWING + 4.0, True),
        ("square_root", 1e-9 * (SWING + 2.0), False),
        ("square_root", 1e-9 * (SWING + 3.0), True),
        ("table", SWING, True),
        ("table", np.where(T > 9.95, 1.0, 0.0), False),
    ],
)
def test_forms_that_make_sense_for_a_signal(form, signal, expected):
    scales = SignalScales([course(v=signal)], ())
    assert scales.allow(FORMS["derivative", form], DER, ("v",)) is expected


@pytest.mark.parametrize("variables", [("v", "w"), ("w", "v")])
def test_a_product_needs_two_signals_that_move(variables):
    scales = SignalScales([course(v=SWING, w=2.0)], ())
    assert not scales.allow(FORMS["derivative", "product"], DER, variables)


def test_an_experiment_without_a_signal_does_not_count():
    scales = SignalScales([course(v=SWING, y=SWING), course(v=SWING)], ())
    coefficient = FormCoefficient("c", None, scale=GridScale.MAX_S, grid=(1.0,))
    assert scales.grid(coefficient, OUT, ()) == pytest.approx((3.0,), rel=1e-3)
