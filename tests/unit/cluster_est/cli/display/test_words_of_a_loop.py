"""Effects in a terminal and in a report's summary, with the words of physics or without."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from cluster_est.cli.display.closed_loop import _print_effect
from cluster_est.report.summary import _named

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
        (0.0, "only data outside the range of these can tell them apart"),
        (3.0, "where they differ most"),
    ],
)
def test_nobody_is_told_to_dwell_where_nothing_differs(difference, advice):
    said = printed(NEW | {"alternatives": [SAME | {"difference": difference}]})
    assert advice in said
    assert "0 times" not in said
