"""What a search ends with: predictions and rivals are those of the model that it returns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_problem,
    made_screening,
)

from cluster_est.closed_loop.selection import beam_search as search
from cluster_est.closed_loop.selection import single_effect
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction, _parts
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.rounds import RejectionReason, RoundEnd, SelectionRound
from cluster_est.closed_loop.selection.single_effect import SingleEffects

PROBLEM = made_problem(50, 50)
BASE = fit_with_squares(PROBLEM, 900.0)
A, B = (made_candidate(name) for name in "ab")


def predicted(_, fitted):
    """A prediction as good as the fit."""
    return LeaveOneOutPrediction(np.array([fitted.sse]))


def screening():
    return made_screening(BASE.jacobian, BASE.residuals, [], [])


@pytest.fixture
def rounds(monkeypatch):
    """Rounds that grow "a", then "a, b", which is revised into "a" alone again, a little better."""
    grown = [fit_with_squares(PROBLEM, 500.0, [A]), fit_with_squares(PROBLEM, 300.0, [A, B])]
    kept = [grown[0], fit_with_squares(PROBLEM, 480.0, [A])]
    ends = iter(grown)

    def one(_, begun):
        won = RefittedCandidate(next(ends), 0.0, True)
        seen = SelectionRound(begun.screening, (), None)
        return RoundEnd(seen, won, predicted(None, won.fitted))

    revised = iter(kept)
    monkeypatch.setattr(search, "predict", predicted)
    monkeypatch.setattr(search, "screen", lambda *_: screening())
    monkeypatch.setattr(search, "noise_of", lambda *_: np.ones(1))
    monkeypatch.setattr(search, "_round", one)
    monkeypatch.setattr(search, "noted", lambda *_: [])
    monkeypatch.setattr(search, "_revised", lambda *_: (next(revised), {}))


@pytest.mark.usefixtures("rounds")
def test_a_prediction_is_that_of_the_model_that_stays():
    found = search.beam_search(made_bench(PROBLEM), BASE, again=False)
    assert found.current.sse == pytest.approx(500.0)
    assert found.prediction.total == pytest.approx(found.current.sse)


def test_a_curve_in_the_place_of_all_effects_has_the_rivals_that_it_was_compared_with(monkeypatch):
    """Else it would be said that nothing else explains the data as well."""
    curves = [made_candidate(name, "table") for name in ("first", "second", "far")]
    contenders = tuple(
        RefittedCandidate(fit_with_squares(PROBLEM, 100.0, [curve]), criterion, True)
        for curve, criterion in zip(curves, (-90.0, -89.9, 500.0), strict=True)
    )
    end = RoundEnd(
        SelectionRound(screening(), contenders, None), contenders[0],
        LeaveOneOutPrediction(np.array([100.0])),
    )  # fmt: skip
    monkeypatch.setattr(single_effect, "best_that_passes", lambda *_: end)
    monkeypatch.setattr(single_effect, "_falls", lambda *_: (1e6, 1e6))
    named = fit_with_squares(PROBLEM, 300.0, [A, B])
    first = SimpleNamespace(model=BASE, screening=SimpleNamespace(count=3), floor=100.0)
    found = single_effect.single_instead(
        made_bench(PROBLEM), first, named, predicted(None, named), SingleEffects(contenders, ())
    )
    assert found is not None
    won, rivals = found.rivals["first"]
    assert won is contenders[0]
    assert [each.candidate.effect.name for each in rivals] == ["second"]


@pytest.mark.parametrize(
    ("family", "added", "whole", "taken"),
    [
        ("table", 1, True, False),  # as a function of one argument it imitates sums of two
        ("table", 2, True, True),
        ("table", 1, False, True),
        ("friction", 1, True, True),
    ],
)
def test_a_name_is_taken_at_once_and_a_curve_waits_for_two_effects(
    monkeypatch, family, added, whole, taken
):
    own = fit_with_squares(PROBLEM, 100.0, [made_candidate("only", family)])
    contender = RefittedCandidate(own, -90.0, True)
    end = RoundEnd(SelectionRound(screening(), (contender,), None), contender, predicted(None, own))
    monkeypatch.setattr(single_effect, "best_that_passes", lambda *_: end)
    monkeypatch.setattr(single_effect, "_falls", lambda *_: (1e6, 1e6))
    grown = fit_with_squares(PROBLEM, 300.0, [A, B][:added])
    first = SimpleNamespace(model=BASE, screening=SimpleNamespace(count=3), floor=100.0)
    singles = SingleEffects((contender,), (contender,))
    found = single_effect.single_instead(
        made_bench(PROBLEM), first, grown, predicted(None, grown), singles, whole=whole
    )
    assert (found is not None) is taken


def test_what_leaves_more_than_noise_is_not_taken_while_a_search_goes_on(monkeypatch):
    own = fit_with_squares(PROBLEM, 200.0, [made_candidate("only")])
    contender = RefittedCandidate(own, -90.0, True)
    end = RoundEnd(SelectionRound(screening(), (contender,), None), contender, predicted(None, own))
    monkeypatch.setattr(single_effect, "best_that_passes", lambda *_: end)
    monkeypatch.setattr(single_effect, "_falls", lambda *_: (1e6, 1e6))
    grown = fit_with_squares(PROBLEM, 300.0, [A, B])
    first = SimpleNamespace(model=BASE, screening=SimpleNamespace(count=3), floor=100.0)
    given = (made_bench(PROBLEM), first, grown, predicted(None, grown))
    singles = SingleEffects((), (contender,))
    assert single_effect.single_instead(*given, singles, whole=True) is None
    assert single_effect.single_instead(*given, singles) is not None


def test_what_is_left_out_are_no_experiments_where_there_are_few():
    """Of one or two experiments quarters of the records are."""
    assert len(_parts(made_bench(PROBLEM))) == 8
    assert "experiment" not in RejectionReason.NOT_PREDICTED
