"""What a closed loop says of its last fits."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.loop_objects import fit_with_squares, made_bench, made_problem, made_result

from cluster_est.closed_loop.account import _not_converged, _notes
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.methods.base import Ending

DONE = made_result(made_problem(20), ())


def ended(ending: Ending):
    return replace(DONE, solution=replace(DONE.solution, ending=ending))


def test_fits_that_converge_need_no_word():
    assert _not_converged(DONE, ended(Ending.PERFECT)) == ()


@pytest.mark.parametrize("ending", [Ending.MAX_ITERATIONS, Ending.STALLED, Ending.START_FAILED])
def test_a_last_fit_that_did_not_converge_is_said_to_be_that(ending):
    (note,) = _not_converged(DONE, ended(ending))
    assert note.startswith("the last fit of the model with the effects did not converge (")
    assert "method.options" not in note  # nothing that a user of a closed loop can set
    cut = ended(ending)
    (note,) = _not_converged(cut, cut)
    assert note.startswith("the last fit of the declared model did not converge (")


@pytest.mark.parametrize("verdict", Verdict)
def test_intervals_that_do_not_allow_for_what_is_left_are_said_to_be_too_narrow(verdict):
    problem = made_problem(20)
    notes = _notes(made_bench(problem), verdict, fit_with_squares(problem, 80.0), DONE, DONE)
    known = verdict in (Verdict.PARTIAL, Verdict.UNEXPLAINED)
    assert any("they are too narrow" in note for note in notes) is known
