"""What a closed loop says of its last fits, and of what its search cost."""

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_problem,
    made_result,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.account import LastFits, account
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.simulation_cost import dear_structures
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.methods.base import Ending

PROBLEM = made_problem(20)
DONE = made_result(PROBLEM, ())


def notes(verdict, before=DONE, after=DONE):
    """The notes of a search that has ended with this verdict, and with these fits."""
    base = fit_with_squares(PROBLEM, 80.0)
    last = made_round(None, made_screening(base.jacobian, base.residuals, [], []))
    found = made_selection(base, base, last)
    fits = LastFits(before, after, (), ())
    return account(made_bench(PROBLEM), found, ReasonedVerdict(verdict, ""), fits).notes


def ended(ending: Ending):
    return replace(DONE, solution=replace(DONE.solution, ending=ending))


def test_fits_that_converge_need_no_word():
    assert not any("converge" in note for note in notes(Verdict.NONE, ended(Ending.PERFECT)))


@pytest.mark.parametrize("ending", [Ending.MAX_ITERATIONS, Ending.STALLED, Ending.START_FAILED])
def test_a_last_fit_that_did_not_converge_is_said_to_be_that(ending):
    (note,) = (n for n in notes(Verdict.NONE, ended(ending)) if "converge" in n)
    assert note.startswith("the last fit of the declared model did not converge (")
    assert "method.options" not in note  # nothing that a user of a closed loop can set


@pytest.mark.parametrize("verdict", [Verdict.NONE, Verdict.COLOURED, Verdict.UNEXPLAINED])
def test_intervals_that_do_not_allow_for_what_is_left_are_said_to_be_too_narrow(verdict):
    narrow = any("they are too narrow" in note for note in notes(verdict))
    assert narrow is (verdict is Verdict.UNEXPLAINED)


def structure(name: str, times: float, *, accepted: bool = False) -> ComparedStructure:
    return ComparedStructure(1, (f"{name} at der(v)",), -10.0, 0.5, True, accepted, times)


def test_nothing_is_said_where_all_cost_about_the_same():
    assert dear_structures([structure("a", 1.2), structure("b", 5.0), structure("c", np.nan)]) == ()


def test_the_dearest_is_named_with_its_figure_and_so_is_what_was_added():
    others = [structure("b", 31.4), structure("c", 7.0)]
    (said,) = dear_structures([structure("a", 1.2), *others])
    assert said.startswith("2 structures of the 3 that were tried")
    assert "most of all b at der(v) (31.4 times)" in said
    assert "what was added" not in said
    (said,) = dear_structures([structure("a", 9.0, accepted=True), *others])
    assert said.endswith("with what was added a simulation takes 9 times the steps")
