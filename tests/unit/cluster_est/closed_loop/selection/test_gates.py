"""What structures must come down to, to be of any use."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import fit_with_squares, made_bench, made_problem, made_screening

from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import best_that_passes, useful_sse
from cluster_est.closed_loop.selection.rounds import RejectionReason, RoundStart

FLOOR = 40.0


def begun(problem, base, model):
    fits = [fit_with_squares(problem, squares) for squares in (base, model)]
    screening = made_screening(fits[0].jacobian, fits[0].residuals, [], [])
    return RoundStart(*fits, LeaveOneOutPrediction(np.ones(1)), screening, FLOOR)


def test_a_structure_that_may_grow_further_is_of_use_whatever_it_leaves():
    problem = made_problem(40, sigma=0.5)
    assert useful_sse(made_bench(problem), begun(problem, 4040.0, 2000.0), 2) == np.inf


@pytest.mark.parametrize(
    ("model", "most"),
    [
        (2040.0, 4040.0 - 0.75 * 4000.0),  # what a claim needs
        (540.0, 540.0 - 0.2 * 500.0),  # what an effect must close
        (100.0, 1.5**2 * FLOOR),  # what may be noise for its size
    ],
)
def test_the_last_effect_must_lead_to_a_claim(model, most):
    problem = made_problem(40, sigma=0.5)
    found = useful_sse(made_bench(problem), begun(problem, 4040.0, model), 3)
    assert found == pytest.approx(most)


def test_without_a_declared_sigma_more_may_be_noise():
    problem = made_problem(40)
    found = useful_sse(made_bench(problem), begun(problem, 4040.0, 1040.0), 3)
    assert found == pytest.approx(5.0**2 * FLOOR)


def test_a_round_in_which_nothing_was_worth_a_refit_says_so():
    problem = made_problem(40)
    end = best_that_passes(made_bench(problem), begun(problem, 90.0, 80.0), [])
    assert end.won is None
    assert end.seen.why is RejectionReason.LITTLE_PROMISED
