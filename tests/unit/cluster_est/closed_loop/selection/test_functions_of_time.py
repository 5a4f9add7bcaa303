"""Functions of time are taken out where more than noise is left beside them."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_problem,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.findings.result import Verdict
from cluster_est.closed_loop.findings.verdict import judge
from cluster_est.closed_loop.selection import functions_of_time as module
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.functions_of_time import (
    functions_of_time,
    without_functions_of_time,
)
from cluster_est.closed_loop.selection.rounds import RejectionReason
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.statistics.omnibus import OmnibusTest

PROBLEM = made_problem(100, 100, 100, 100)
FLOOR = 400.0
FRICTION, DRIFT, OTHER = (
    made_candidate(name, family)
    for name, family in (("friction", "friction"), ("drift", "load"), ("other", "friction"))
)
STRUCTURED = OmnibusTest(0.0025, 30.0)


def search(*added, now=5.0):
    base = fit_with_squares(PROBLEM, 100.0 * FLOOR)
    current = fit_with_squares(PROBLEM, now * FLOOR, added)
    screening = made_screening(
        current.jacobian, current.residuals, [], [], omnibus=STRUCTURED, p=0.001, p_white=0.001
    )
    return made_selection(base, current, made_round(RejectionReason.LITTLE_EXPLAINED, screening))


@pytest.fixture
def bench(monkeypatch):
    """A workbench; what is fitted again leaves 20 times the squares of the noise."""

    def fit(_, __, starts, ___):
        return [fit_with_squares(PROBLEM, 20.0 * FLOOR, start.added) for start in starts]

    def screened(_, fitted, __):
        return made_screening(
            fitted.jacobian, fitted.residuals, [], [], omnibus=STRUCTURED, p=0.001, p_white=0.001
        )

    def predicted(_, fitted):
        return LeaveOneOutPrediction(np.full(4, fitted.sse / 4))

    monkeypatch.setattr(LoopWorkbench, "fit", fit)
    monkeypatch.setattr(module, "screen", screened)
    monkeypatch.setattr(module, "predict", predicted)
    monkeypatch.setattr(module, "is_usable", lambda *_: True)
    return made_bench(PROBLEM)


def test_what_remains_of_drifts_alone_is_the_declared_model(bench):
    """A drift that closes 95 % of the gap would be "partial" without it."""
    found = search(DRIFT)
    assert functions_of_time(found) == (DRIFT,)
    assert judge(bench, found).verdict is Verdict.PARTIAL
    less = without_functions_of_time(bench, found)
    assert less.current is found.base
    assert less.prediction is found.base_prediction
    judged = judge(bench, less)
    assert judged.verdict is Verdict.UNEXPLAINED
    assert "as they do with any slow disturbance" in judged.reason


@pytest.mark.parametrize("added", [(FRICTION, DRIFT, OTHER), (DRIFT, FRICTION, OTHER)])
def test_other_effects_stay_and_are_fitted_again(bench, added):
    less = without_functions_of_time(bench, search(*added))
    assert less.current.structure == {"friction", "other"}
    assert less.current.sse == pytest.approx(20.0 * FLOOR)
    assert less.prediction.total == pytest.approx(20.0 * FLOOR)
    assert less.path[-1].accepted
    assert judge(bench, less).verdict is Verdict.PARTIAL


def test_what_cannot_be_simulated_without_them_does_not_stay(bench, monkeypatch):
    monkeypatch.setattr(LoopWorkbench, "fit", lambda *_: [None])
    found = search(DRIFT, FRICTION)
    assert without_functions_of_time(bench, found).current is found.base


def test_what_runs_away_or_cannot_be_linearised_does_not_stay(bench, monkeypatch):
    monkeypatch.setattr(module, "is_usable", lambda *_: False)
    found = search(DRIFT, FRICTION)
    assert without_functions_of_time(bench, found).current is found.base


def test_a_search_without_them_has_none():
    assert functions_of_time(search(FRICTION, OTHER)) == ()
