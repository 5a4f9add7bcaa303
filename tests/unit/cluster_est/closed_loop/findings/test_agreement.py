"""Equations that agree where the data were, and where they would not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.loop_objects import made_bench, made_problem, made_result

from cluster_est import Parameter
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.agreement import CLOSE, agreements
from cluster_est.closed_loop.findings.wording import _agreeing
from cluster_est.closed_loop.findings.words.laws import Law
from cluster_est.closed_loop.findings.words.naming import Namer
from cluster_est.results.tables.row_types import EffectCurve, Estimate
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.messages import Effect

K = -0.352


def curve(low, high, shape, error=0.01, counts=None) -> EffectCurve:
    """A curve over a range of the data, with a standard error that is a share of its size."""
    x = np.linspace(low, high, 201)
    y = shape(x)
    half = 1.96 * error * np.abs(y).max() * np.ones(len(x))
    edges = np.linspace(low, high, 49)
    counts = np.ones(48) if counts is None else counts
    return EffectCurve("e", "der(v)", "v", "m/s", "m/s2", x, y, y - half, y + half, edges, counts)


def square(x):
    return K * x**2


def switch(x):
    return K * np.tanh(x / 0.02)


def test_a_square_of_a_speed_that_keeps_its_sign_is_also_a_drag():
    (found,) = agreements(curve(0.3, 2.1, square), square, Law.SQUARE)
    assert found.law is Law.ODD_SQUARE
    assert found.found.equation == "-0.352 * v * abs(v)"
    assert found.found.share < 1e-12
    assert found.found.told_at < 0.0
    expected = abs(square(found.found.told_at) - K * -(found.found.told_at**2))
    assert found.found.told_by == pytest.approx(expected)


def test_a_speed_that_takes_both_signs_tells_them_apart():
    assert agreements(curve(-2.0, 2.1, square), square, Law.SQUARE) == ()


def test_a_switch_away_from_zero_is_a_constant():
    found = agreements(curve(0.3, 2.1, switch), switch, Law.SWITCH)
    assert Law.CONSTANT in [a.law for a in found]
    (constant,) = [a for a in found if a.law is Law.CONSTANT]
    assert constant.found.equation == "-0.352"
    assert constant.found.told_at < 0.3


def test_what_cannot_be_negative_is_not_told_apart_there():
    """Over amounts v^2 and v|v| are one equation in two ways of writing."""
    assert agreements(curve(0.3, 2.1, square), square, Law.SQUARE, negative=False) == ()


def test_a_narrow_range_leaves_the_exponent_open_if_the_effect_is_not_known_better():
    def linear(x):
        return K * x

    wide = agreements(curve(9.8, 10.2, linear, error=0.03), linear, Law.LINEAR)
    assert len(wide) == 3  # the closest
    assert all(0.0 < a.found.share <= CLOSE for a in wide)
    sharp = agreements(curve(9.8, 10.2, linear, error=1e-5), linear, Law.LINEAR)
    assert {a.law for a in sharp} <= {Law.ABSOLUTE}


def test_only_bins_with_samples_count():
    """A gap in the data around zero, in which a square and a magnitude differ, tells nothing."""
    counts = np.zeros(48)
    counts[:3] = counts[-3:] = 1.0
    found = agreements(curve(-1.0, 1.0, square, 0.05, counts), square, Law.SQUARE)
    assert Law.ABSOLUTE in [a.law for a in found]
    assert agreements(curve(-1.0, 1.0, square, 0.05), square, Law.SQUARE) == ()


def test_nothing_is_said_of_what_is_no_curve_or_one_in_time():
    empty = EffectCurve("e", "der(v)", why_not="it depends on the past", edges=np.zeros(1))
    assert agreements(empty, square, Law.SQUARE) == ()


def test_an_undetermined_band_leaves_only_equations_that_are_the_same_there():
    plain = curve(0.3, 2.1, square)
    unknown = EffectCurve(
        "e", "der(v)", "v", "m/s", "m/s2", plain.x, plain.y, plain.y * np.nan, plain.y * np.nan,
        plain.edges, plain.counts,
    )  # fmt: skip
    assert [a.law for a in agreements(unknown, square, Law.SQUARE)] == [Law.ODD_SQUARE]


@given(st.floats(1e-3, 1e3), st.floats(1e-4, 1e4), st.sampled_from([1.0, -1.0]))
def test_units_of_variable_and_effect_change_no_finding(over, by, sign):
    plain = agreements(curve(0.3, 2.1, square), square, Law.SQUARE)

    def scaled(x):
        return sign * by * square(x / over)

    other = agreements(curve(0.3 * over, 2.1 * over, scaled), scaled, Law.SQUARE)
    assert [a.law for a in other] == [a.law for a in plain]
    assert other[0].found.told_at == pytest.approx(over * plain[0].found.told_at)
    assert other[0].found.told_by == pytest.approx(by * plain[0].found.told_by)


def test_a_finding_carries_the_other_equation_with_its_name():
    """From the effect and its numbers on, as the loop hands them over."""
    made = EffectCandidate(
        Effect("square_v", "der(v)", "square", ("v",)),
        FORMS["derivative", "square"], EffectSite("derivative", "v"), True, (), (-9.0,), (9.0,),
    )  # fmt: skip
    plain, k = made_problem(50), Parameter("square_v.k", K)
    problem = replace(plain, effects=(made.effect,), parameters=(*plain.parameters, k))
    bench = made_bench(plain)
    fields = dict.fromkeys(Estimate.__annotations__, "")
    number = {"label": "square_v.k", "parameter": "square_v.k", "value": K}
    result = replace(
        made_result(plain, []), problem=problem, estimates=(Estimate(**(fields | number)),)
    )
    own = replace(curve(0.3, 2.1, square), effect="square_v")
    namer = Namer(bench.description, {})
    named = namer.name(made, [K], own)
    assert named.words == "drag"
    (also,) = _agreeing(bench, result, namer, named, own)
    assert (also.equation, also.words) == ("-0.352 * v * abs(v)", "drag")
    assert _agreeing(bench, result, namer, named, replace(own, why_not="no curve")) == ()
