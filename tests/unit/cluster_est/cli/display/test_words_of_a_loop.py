"""Effects in a terminal and in a report's summary, with the words of physics or without."""

from __future__ import annotations

import io
import math

import pytest
from rich.console import Console

from cluster_est.cli.display.closed_loop import (
    _failed,
    _print_effect,
    _print_errors,
    _print_rest,
    print_loop,
)
from cluster_est.report.summary import _named
from cluster_est.run_folder.reading import StoredRun

OLD = {
    "name": "square_v", "family": "stiffness", "site": "der(v)", "form": "square",
    "variables": ["v"], "equation": "der(v) += k * v^2", "alternatives": [], "evidence": [],
    "parameters": {"k": {"value": -0.35, "unit": "1/m", "fixed": False, "lower95": None,
                         "upper95": None}},
}  # fmt: skip
NEW = OLD | {"words": "drag", "sentence": "Drag at der(v): der(v) += k * v^2.", "also": []}
SAME = {
    "form": "table", "site": "der(v)", "equation": "der(v) += table", "criterion": 1.0,
    "experiment": "a", "output": "y", "time": 1.0, "difference": 0.0,
}  # fmt: skip


def printed(effect) -> str:
    out = io.StringIO()
    _print_effect(Console(file=out, width=200), effect)
    return out.getvalue()


def test_a_run_of_an_earlier_version_is_shown_with_what_it_has():
    said = printed(OLD)
    assert "effect square_v (stiffness) at der(v)" in said
    assert "  der(v) += k * v^2" in said
    assert _named(OLD) == "square of v at der(v)"


def test_words_and_sentence_take_the_place_of_family_and_equation():
    said = printed(NEW)
    assert "effect square_v (drag) at der(v)" in said
    assert "  Drag at der(v): der(v) += k * v^2." in said
    assert "stiffness" not in said
    assert _named(NEW) == "drag at der(v)"


@pytest.mark.parametrize(
    ("difference", "advice"),
    [
        (0.0, "nothing in these data tells them apart"),
        (3.0, "where they differ most"),
    ],
)
def test_nobody_is_told_to_dwell_where_nothing_differs(difference, advice):
    said = printed(NEW | {"alternatives": [SAME | {"difference": difference}]})
    assert advice in said
    assert "0 times" not in said


def test_a_coefficient_at_its_bound_is_not_said_to_be_undetermined():
    held = NEW["parameters"]["k"] | {"at_bound": "lower"}
    said = printed(NEW | {"parameters": {"k": held}})
    assert "95 %: at its lower bound" in said
    assert "not determined" not in said


ROW = {
    "experiment": "a", "role": "train", "output": "y", "samples": 100, "unit": "m",
    "rmse_before": 2.0, "rmse_after": 1.0, "normalised_before": 4.0, "normalised_after": 2.0,
}  # fmt: skip
NOISELESS = ROW | {"normalised_before": math.nan, "normalised_after": math.nan}
LOST = NOISELESS | {"rmse_before": math.nan, "rmse_after": math.nan}


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (ROW, ["2", "1", "m", "4", "2"]),
        (NOISELESS, ["2", "1", "m", "unknown", "unknown"]),
        (LOST, ["failed", "failed", "m", "failed", "failed"]),
        (LOST | {"samples": 0}, ["m"]),
    ],
    ids=["known", "without noise", "lost", "without samples"],
)
def test_only_a_simulation_that_failed_is_said_to_have_failed(row, words):
    out = io.StringIO()
    facts = {"errors_over": "estimated noise", "errors": {}}
    _print_errors(Console(file=out, width=200), [row], facts)
    assert out.getvalue().splitlines()[2].split()[4:] == words


def test_a_noise_that_is_not_known_has_not_failed():
    out = io.StringIO()
    facts = {"rejected": [], "noise": {"y": None}, "sites": []}
    _print_rest(Console(file=out, width=200), facts)
    assert "noise estimated from the residuals: y unknown" in out.getvalue()


PARAMETER = {
    "label": "k", "value": 1.0, "lower95": 0.9, "upper95": 1.1, "value_before": 2.0,
    "lower95_before": 1.9, "upper95_before": 2.1, "unit": "N", "estimated_on": "train",
    "at_bound": "",
}  # fmt: skip


@pytest.mark.parametrize(("verdict", "narrow"), [("unexplained", True), ("found", False)])
def test_intervals_without_what_is_missing_are_said_to_be_too_narrow(tmp_path, verdict, narrow):
    effect = NEW | {"config": "", "parameters": {"k": NEW["parameters"]["k"] | {
        "lower95": -0.4, "upper95": -0.3}}}  # fmt: skip
    facts = {
        "verdict": verdict, "summary": "", "simulations": 1, "failures": 0, "seconds": 1.0,
        "effects": [effect], "errors_over": "sigma", "errors": {}, "notes": [], "rejected": [],
        "noise": {}, "sites": [],
    }  # fmt: skip
    out = io.StringIO()
    run = StoredRun(tmp_path, facts, {"parameters": [PARAMETER], "errors": [ROW]})
    print_loop(Console(file=out, width=200), run)
    assert ("after  95 % interval (too narrow)" in out.getvalue()) is narrow
    assert ("95 % (too narrow): -0.4 .. -0.3" in out.getvalue()) is narrow


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"failures": 8}, "8 failed"),  # a run of an earlier version
        ({"failures": 8, "failures_in_search": 0}, "8 failed"),
        (
            {"failures": 8, "failures_in_search": 8},
            "8 failed, all while effects were tried",
        ),
        (
            {"failures": 8, "failures_in_search": 6},
            "8 failed, 6 while effects were tried",
        ),
    ],
)
def test_failures_of_effects_that_were_only_tried_are_called_so(facts, said):
    assert _failed(facts) == said
