"""What a report says of errors and costs, from a few rows."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cluster_est.report.activity import LogActivity
from cluster_est.report.error_sizes import error_sentence
from cluster_est.report.folder import ReportedRun
from cluster_est.report.sections.errors import errors
from cluster_est.report.summary import _costs, _failed, _figures


def row(before: float, after: float, samples: int = 10) -> dict[str, Any]:
    name = "a" if samples else "empty"
    kinds = ("rmse", "normalised", "relative")
    sizes = {f"{kind}_before": before for kind in kinds} | {f"{k}_after": after for k in kinds}
    return (
        {"experiment": name, "output": "y", "role": "train", "unit": "m"}
        | sizes
        | {"samples": samples}
    )


def run(*rows: dict[str, Any], before: float = 3.0, after: float = 3.0, is_loop: bool = True):
    facts = {"errors_over": "estimated noise", "cost_before": before, "cost": after}
    return SimpleNamespace(
        tables={"errors": rows}, facts=facts, is_loop=is_loop, finished=True, before="declared"
    )


EMPTY = row(math.nan, math.nan, samples=0)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (1.5, 1.5, "The error is 1.50 times the estimated noise on training experiments."),
        (1.5, 1.2, "The error fell from 1.50 to 1.20 times"),
        (1.2, 1.5, "The error rose from 1.20 to 1.50 times"),
        (math.nan, 1.5, "The error is 1.50 times"),
    ],
)
def test_an_error_that_stays_has_not_fallen(before, after, said):
    assert error_sentence(run(row(before, after))).startswith(said)


def test_a_cost_that_stays_has_not_fallen():
    assert _costs(run()) == ["The cost is 3.000, as it was with the declared model, fitted."]
    assert _costs(run(is_loop=False)) == ["The cost is 3.000, as it was at the start values."]
    assert _costs(run(after=1.5))[0].startswith("The cost fell")
    assert _costs(run(after=6.0))[0].startswith("The cost rose")


def test_an_experiment_without_samples_of_an_output_hides_no_error():
    assert "fell from 2.00 to 1.00 times" in error_sentence(run(row(2.0, 1.0), EMPTY))


def test_an_experiment_without_samples_has_not_failed():
    pooled, single = errors(run(row(2.0, 1.0), EMPTY)).blocks[1:]
    texts = [[cell.text for cell in line] for table in (pooled, single) for line in table.rows]
    assert not any("failed" in line for line in texts)
    assert texts[0][4] == "1.000"
    lost = errors(run(row(2.0, math.nan))).blocks[1]
    assert "failed" in [cell.text for cell in lost.rows[0]]


@pytest.mark.parametrize(
    ("logged", "counted", "said"),
    [((0, 0), (100, 7), "7 failed"), ((50, 2), (100, 7), "2 failed"), ((0, 0), (9, 0), "none")],
)
def test_failures_of_a_run_without_a_log_are_not_forgotten(logged, counted, said):
    """A run that was saved from Python has none."""
    simulations, failed = logged
    groups = (SimpleNamespace(count=failed),) if failed else ()
    activity = SimpleNamespace(simulations=simulations, failures=groups)
    facts = dict(zip(("simulations", "failures"), counted, strict=True))
    tables = {"errors": (), "workers": ()}
    made = SimpleNamespace(facts=facts, tables=tables, activity=activity, is_loop=True)
    (figure,) = _figures(made)
    assert figure.more.startswith(said)
    assert bool(_failed(made)) is (said != "none")


@pytest.mark.parametrize(
    ("tried", "said"),
    [
        (0, "7 of 100 simulations failed (7.00 %)."),
        (7, "(7.00 %), all of them while effects were tried."),
        (5, "(7.00 %), 5 of them while effects were tried."),
    ],
)
def test_failures_of_effects_that_were_only_tried_are_called_so(tried, said):
    activity = SimpleNamespace(simulations=100, failures=(SimpleNamespace(count=7),))
    facts = {"simulations": 100, "failures": 7, "failures_in_search": tried}
    (sentence,) = _failed(SimpleNamespace(facts=facts, activity=activity, is_loop=True))
    assert sentence.replace("\u2009", " ").endswith(said)


@pytest.mark.parametrize(
    ("facts", "narrow"),
    [
        ({"verdict": "unexplained", "residuals": None}, True),
        ({"verdict": "found", "residuals": None}, False),
        ({"residuals": {"too_narrow": True}}, True),
        ({"residuals": {"too_narrow": False}}, False),
    ],
)
def test_intervals_do_not_allow_for_what_is_missing(facts, narrow):
    activity = LogActivity(0, (), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), ())
    assert ReportedRun("run", facts, "", {}, None, None, activity).too_narrow is narrow
