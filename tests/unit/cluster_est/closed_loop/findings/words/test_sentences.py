"""Findings as one would say them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.effects import AgreeingEquation
from cluster_est.closed_loop.findings.words.sentences import sentence_of
from cluster_est.results.tables.row_types import EffectCurve, Estimate
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.messages import Effect


def candidate(site: EffectSite, form: str, *variables: str) -> EffectCandidate:
    found = FORMS[site.kind, form]
    return EffectCandidate(Effect("e", str(site), form, variables), found, site, True, (), (), ())


def estimate(name: str, value: float, unit: str = "", error: float = 0.01, on: str = "train"):
    fields = dict.fromkeys(Estimate.__annotations__, "")
    known = {
        "parameter": f"e.{name}", "value": value, "unit": unit, "estimated_on": on,
        "lower95": value - 2.0 * error, "upper95": value + 2.0 * error, "std_error": error,
        "error_white": error, "error_autoregression": error, "error_experiments": error,
    }  # fmt: skip
    return Estimate(**(fields | known))


def curve(low=0.3, high=2.1) -> EffectCurve:
    x = np.linspace(low, high, 5)
    return EffectCurve("e", "der(v)", "v", "m/s", "m/s2", x, -(x**2))


def test_a_force_with_its_range():
    made = candidate(EffectSite("derivative", "v"), "coulomb", "v")
    numbers = [estimate("k", 0.5, "m/s2"), estimate("width", 0.001, "m/s", on="known")]
    assert sentence_of("Coulomb friction", made, numbers, curve(-0.6, 0.6)) == (
        "Coulomb friction at der(v): der(v) += -k * tanh(v / width), with k = 0.5 m/s2 "
        "(0.48 to 0.52); in the data v went from -0.6 to 0.6 m/s."
    )


def test_two_names_and_where_to_tell_them_apart():
    made = candidate(EffectSite("derivative", "v"), "square", "v")
    also = AgreeingEquation("-1 * v * abs(v)", "drag", 1e-17, 1e-18, -0.74, 0.386)
    said = sentence_of("drag", made, [estimate("k", -1.0)], curve(), [also])
    assert said.endswith(
        "On that range it is also -1 * v * abs(v) (drag): at v = -0.74 m/s the two would differ by "
        "0.39 m/s2, so measure there to tell them apart."
    )
    near = AgreeingEquation("-0.9 * v^3", "", 0.02, 0.005, 3.0, 1.0)
    said = sentence_of("drag", made, [estimate("k", -1.0)], curve(), [near])
    assert "On that range it is, but for 0.02 m/s2 (0.5%), also -0.9 * v^3: at v = 3 m/s" in said


def test_a_pair_and_a_value_that_is_not_determined():
    made = candidate(EffectSite("pair", "a", "b"), "linear", "a - b")
    numbers = [estimate("k", 2.0, "?/s"), estimate("back", 1.0, "1", error=math.nan)]
    said = sentence_of("heat conduction or convection", made, numbers, None)
    assert said.startswith("Heat conduction or convection between a and b: der(a) += ")
    assert said.endswith("with k = 2 (1.98 to 2.02) and back = 1 (not determined).")


@pytest.mark.parametrize(("period", "text"), [(86_400.0, "24 h"), (3.2, "3.2 s")])
def test_a_wave_says_its_period(period, text):
    made = candidate(EffectSite("derivative", "v"), "sine")
    said = sentence_of("a wave in time", made, [estimate("a", 1.0)], None, period=period)
    assert said.endswith(f", a period of {text}.")


def test_a_free_curve_lists_no_values():
    made = candidate(EffectSite("derivative", "v"), "table", "v")
    said = sentence_of("a free curve of v", made, [estimate("k1", 1.0)], curve())
    assert "with k1" not in said


def test_a_coefficient_at_its_bound_is_not_said_to_be_undetermined():
    made = candidate(EffectSite("derivative", "v"), "square", "v")
    held = replace(estimate("k", 0.0), lower95=math.nan, upper95=math.nan, at_bound="lower")
    assert "with k = 0 (at its lower bound)" in sentence_of("drag", made, [held], curve())


@pytest.mark.parametrize(("form", "where"), [
    ("power", "abs(m) = 0.12 kg/s"), ("linear", "m = 0.12 kg/s"), ("square", "m^2 = 0.12 kg/s"),
])  # fmt: skip
def test_a_parameter_that_varies_is_the_one_at_a_place(form, where):
    made = candidate(EffectSite("parameter", "UA"), form, "m")
    numbers = [estimate("n", 0.6), estimate("at", 0.12, "kg/s", on="known")]
    said = sentence_of("a power law in m", made, numbers, None)
    assert said.endswith(f"; the value of UA is the one at {where}.")


def test_what_has_no_such_place_says_none():
    made = candidate(EffectSite("derivative", "v"), "hinge", "x")
    numbers = [estimate("k", 0.6), estimate("at", 0.12, "m")]
    assert "the one at" not in sentence_of("a spring", made, numbers, None)
