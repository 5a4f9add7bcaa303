import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_problem,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop import search
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.closed_loop.search import SearchLog, _judged_answers
from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.rounds import RejectionReason
from cluster_est.closed_loop.settings import LoopSettings

DRIFT, RUBS = made_candidate("drifts", "load"), made_candidate("rubs")
PROBLEM = made_problem(100)
BASE = fit_with_squares(PROBLEM, 10_000.0)


def result(log, candidate):
    """A search whose answer is one effect."""
    screening = made_screening(BASE.jacobian, BASE.residuals, [np.ones((100, 1))], [RUBS])
    last = made_round(RejectionReason.NO_IMPROVEMENT, screening)
    fitted = fit_with_squares(PROBLEM, 400.0, (candidate,))
    return made_selection(BASE, fitted, last, settings=log.settings)


def ends(monkeypatch, first, *, verdict=Verdict.PARTIAL):
    """The judged answers of a search that first finds these effects, and friction when repeated."""
    asked = []

    def grown(log):
        asked.append(log)
        return result(log, first[0] if len(asked) == 1 else RUBS)

    def answers(*_):
        given = first if len(asked) == 1 else [RUBS]
        return [result(asked[-1], each) for each in given]

    monkeypatch.setattr(search, "answers", answers)
    monkeypatch.setattr(search, "judge", lambda *_: ReasonedVerdict(verdict, "so it is"))
    predicted = LeaveOneOutPrediction(np.array([10_000.0]))
    log = SearchLog(None, LoopSettings(), BASE, predicted, np.ones(1), 100.0, path=["a row"])
    return asked, log, _judged_answers(grown, log)


def names(found):
    return [[c.form.name for c in each.current.added] for each, _ in found]


def test_a_drift_that_leaves_more_than_noise_starts_a_search_without_functions_of_time(monkeypatch):
    asked, log, found = ends(monkeypatch, [DRIFT])
    assert [each.settings.without for each in asked] == [(), ("functions of time",)]
    assert asked[1].path == asked[1].rounds == asked[1].accepted == []
    assert log.path == ["a row"]
    assert names(found) == [["coulomb"]]
    ((answer, judged),) = found
    assert answer.settings == log.settings
    assert judged.reason.startswith("so it is; drift at ")
    assert "would leave more than noise and was not added" in judged.reason


@pytest.mark.parametrize(
    ("first", "verdict"), [([DRIFT], Verdict.FOUND), ([RUBS], Verdict.PARTIAL)]
)
def test_a_drift_that_leaves_noise_and_a_mechanism_stay(monkeypatch, first, verdict):
    asked, _, found = ends(monkeypatch, first, verdict=verdict)
    assert len(asked) == 1
    assert names(found) == [[first[0].form.name]]
    assert found[0][1].reason == "so it is"


def test_a_later_answer_with_such_a_drift_is_left_out(monkeypatch):
    asked, _, found = ends(monkeypatch, [RUBS, DRIFT])
    assert len(asked) == 1
    assert names(found) == [["coulomb"]]
