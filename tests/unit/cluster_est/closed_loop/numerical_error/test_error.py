"""What a numerical error of some size means, and what is said of it."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import fit_with_squares, made_bench, made_problem, made_screening

from cluster_est import Solver
from cluster_est.closed_loop.numerical_error.error import (
    NumericalError,
    extrapolated,
    observed_order,
)
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import coloured_noise_explains, failed_gate
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.visited_models import VisitedModels
from cluster_est.closed_loop.selection.rounds import RejectionReason, RoundStart
from cluster_est.results.solver_error.finer_solver import SolverScale

STEP = SolverScale(Solver("fmu", step=0.1), "the communication step of 0.1 s", step=0.1)
RTOL = SolverScale(
    Solver("dormand_prince", rtol=1e-3), "the tolerance model.rtol = 0.001", rtol=1e-3, ratio=100.0
)


def error(rms, residual, scale=STEP, order=1.0, noise=1.0):
    arrays = [np.array([0.0, value]) for value in (rms, noise, residual)]
    return NumericalError(scale, ("x", "y"), *arrays, squares=rms**2 * 100.0, order=order)


@pytest.mark.parametrize("order", [1.0, 2.0, 4.0])
def test_order_and_error_follow_from_three_solutions(order):
    """Solutions with an error C h^p exactly."""
    c = np.array([1.0, -2.0, 0.5])
    errors = [c * h**order for h in (0.1, 0.05, 0.025)]
    first, second = errors[0] - errors[1], errors[1] - errors[2]
    assert observed_order(first, second, 2.0) == pytest.approx(order)
    np.testing.assert_allclose(extrapolated(first, 2.0, order), errors[0])


def test_of_first_order_the_error_is_twice_the_change():
    assert extrapolated(np.array([3.0]), 2.0, 1.0) == pytest.approx([6.0])


def test_an_order_that_events_spoil_is_kept_within_what_a_step_has():
    one = np.ones(2)
    assert observed_order(one, 3.0 * one, 2.0) == 1.0
    assert observed_order(one, 1e-9 * one, 2.0) == 4.0
    assert observed_order(one, 0.0 * one, 2.0) == 4.0


@pytest.mark.parametrize(
    ("rms", "residual", "hides"), [(0.4, 1.0, False), (0.6, 1.2, True), (4.3, 4.4, True),
                                   (4.3, 100.0, False), (0.6, 7.0, False)]
)  # fmt: skip
def test_an_error_hides_effects_that_is_large_beside_noise_and_residual(rms, residual, hides):
    assert error(rms, residual).hides_effects is hides


def test_the_refusal_says_how_large_and_what_to_set():
    said = error(4.3, 4.4).refusal
    assert said == (
        "the communication step of 0.1 s has an error of 4.3 times the noise (at y, of order 1 in "
        "the step), so no missing effect can be distinguished from it: set "
        "model.step = 0.0007813 first, and run this again"
    )
    assert error(4.3, 4.4).notes[0].startswith("no effect was looked for, because the commun")


def test_a_smaller_error_is_a_note_and_a_negligible_one_is_none():
    (note,) = error(0.12, 1.0, order=2.0).notes
    assert "0.12 times the noise" in note
    assert "model.step = 0.05 makes it negligible" in note
    assert error(0.04, 1.0).notes == ()
    assert error(0.0, 0.0, noise=0.0).notes == ()


def test_a_loose_tolerance_is_spoken_of_however_small_its_error_is_here():
    (note,) = error(1e-5, 1.0, RTOL, np.nan).notes
    assert "1e-05 times the noise" in note
    assert "negligible here; model.rtol = 1e-04 keeps it so elsewhere" in note


def test_where_there_is_no_noise_the_residual_decides():
    assert error(1e-9, 1e-9, noise=0.0).hides_effects
    assert "an error of 1 times all that is left" in error(1e-9, 1e-9, noise=0.0).refusal
    (note,) = error(1e-9, 1.0, noise=0.0).notes
    assert "an error of 1e-09 times all that is left" in note
    assert not error(1e-9, 1.0, noise=0.0).hides_effects
    assert not error(1e-9, 0.0, noise=0.0).hides_effects


def test_what_could_not_be_measured_is_said():
    (note,) = NumericalError(STEP, why_not="battery.fmu communicates in a fixed step").notes
    assert "could not be measured: battery.fmu communicates in a fixed step" in note
    assert not NumericalError(STEP, why_not="because").hides_effects


@pytest.mark.parametrize(("after", "refused"), [(700.0, True), (500.0, False)])
def test_an_effect_must_explain_more_than_the_numerical_error_could(after, refused):
    """An error of squares 100, known up to a factor of 2, could account for a fall of 400."""
    problem = made_problem(40)
    bench, base = made_bench(problem), fit_with_squares(problem, 1000.0)
    screening = made_screening(base.jacobian, base.residuals, [], [])
    predicted = LeaveOneOutPrediction(np.array([1000.0]))
    most = error(1.0, 1.0).explainable
    begun = RoundStart(
        base, base, predicted, screening, VisitedModels(1.0), floor=1000.0, numerical=most
    )
    grown = RefittedCandidate(fit_with_squares(problem, after), criterion=0.0, full=True)
    coloured = coloured_noise_explains(bench, begun, grown)
    predicted = LeaveOneOutPrediction(np.array([after]))
    why = failed_gate(bench, begun, grown.fitted, predicted, 10.0, 1.0, coloured=coloured)
    assert why is (RejectionReason.NUMERICAL_ERROR if refused else None)
