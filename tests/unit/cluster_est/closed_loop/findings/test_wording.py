"""What was found, in words and numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_fit,
    made_problem,
    made_result,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.findings.wording import (
    _largest_difference,
    error_changes,
    shared_arguments,
    where_left,
)
from cluster_est.closed_loop.selection.rounds import RejectionReason
from cluster_est.results.output_errors import OutputError


def followed(problem, rmse, sigma):
    """A result in which an output is followed with this error."""
    error = OutputError(
        experiment="run 0", role="train", output="y0", unit="m", samples=50,
        rmse_before=9.0, rmse_after=rmse, relative_before=9.0, relative_after=9.0,
        normalised_before=9.0, normalised_after=rmse / sigma,
    )  # fmt: skip
    return made_result(problem, [error])


def changes(sigma, noise):
    """Normalised errors of 0.6 and 0.2 with this sigma and this noise, both in units of y0."""
    problem = made_problem(50, sigma=sigma)
    fitted = fit_with_squares(problem, 1.0)
    screening = made_screening(fitted.jacobian, fitted.residuals, [], [])
    last = made_round(RejectionReason.NOT_SIGNIFICANT, screening)
    found = made_selection(fitted, fitted, last, noise=[noise / sigma])
    before, after = (followed(problem, rmse, sigma) for rmse in (0.6, 0.2))
    (row,) = error_changes(made_bench(problem), found, before, after)
    assert (row.experiment, row.role, row.output) == ("run 0", "train", "y0")
    assert (row.unit, row.samples) == ("m", 50)
    assert (row.rmse_before, row.rmse_after) == (0.6, 0.2)
    return row.normalised_before, row.normalised_after


def test_errors_are_over_the_given_sigma_or_else_over_the_noise():
    assert changes(0.5, 0.1) == pytest.approx((1.2, 0.4))
    assert changes(1.0, 0.1) == pytest.approx((6.0, 2.0))


@pytest.mark.parametrize("noise", [0.0, np.nan])
def test_without_noise_there_is_nothing_to_be_over(noise):
    assert np.isnan(changes(1.0, noise)).all()


def test_where_two_models_differ_most_for_their_noise():
    """The larger difference is in y0, whose noise is larger still; the test run counts not."""
    problem = made_problem(50, 50, 50, outputs=2, roles=("train", "test", "train"))
    one, other = np.zeros(200), np.zeros(200)
    other[10] = -8.0
    other[150 + 49] = 2.0  # second training experiment, y1, last sample
    where, when, output, size = _largest_difference(
        made_bench(problem), made_fit(problem, one), made_fit(problem, other),
        np.array([4.0, 0.5]),
    )  # fmt: skip
    assert (where, output) == ("run 2", "y1")
    assert (when, size) == pytest.approx((1.0, 4.0))


def test_an_output_without_samples_in_an_experiment_is_passed_over():
    runs = made_problem(50, 50, outputs=2).experiments
    nothing = np.zeros(0)
    shorter = replace(runs[0].outputs[1], times=nothing, values=nothing)
    runs = (replace(runs[0], outputs=(runs[0].outputs[0], shorter)), runs[1])
    problem = replace(made_problem(50, 50, outputs=2), experiments=runs)
    residuals = np.ones(150)
    residuals[-1] = 30.0
    said = where_left(made_bench(problem), made_fit(problem, residuals))
    assert "output y1 of experiment 'run 1'" in said


def test_what_is_spread_evenly_is_in_no_part():
    problem = made_problem(200, 200)
    noise = np.random.default_rng(4).standard_normal(400)
    said = where_left(made_bench(problem), made_fit(problem, noise))
    assert said == "what is left is spread over all records, with no part that stands out"


def test_where_nothing_is_left_no_part_is_named():
    problem = made_problem(50)
    assert where_left(made_bench(problem), made_fit(problem, np.zeros(50))) == "nothing is left"


def test_an_experiment_that_could_not_be_simulated_before_counts_after():
    problem = made_problem(50, sigma=0.5)
    fitted = fit_with_squares(problem, 1.0)
    screening = made_screening(fitted.jacobian, fitted.residuals, [], [])
    last = made_round(RejectionReason.NOT_SIGNIFICANT, screening)
    found = made_selection(fitted, fitted, last, noise=[1.0])
    before, after = (followed(problem, rmse, 0.5) for rmse in (np.nan, 2.0))
    (row,) = error_changes(made_bench(problem), found, before, after)
    assert np.isnan(row.normalised_before)
    assert row.normalised_after == pytest.approx(4.0)


def test_where_and_when_most_of_a_residual_lives():
    problem = made_problem(100, 100)
    residuals = np.ones(200)
    residuals[100 + 41 : 100 + 44] = 10.0
    said = where_left(made_bench(problem), made_fit(problem, residuals))
    assert "output y0 of experiment 'run 1'" in said
    assert f"({302 / (197 + 300):.0%})" in said
    start, stop = (float(x) for x in said.split("t = ")[1].removesuffix(" s").split(" and "))
    times = problem.experiments[1].outputs[0].times
    assert start <= times[41] < times[43] <= stop
    assert stop - start == pytest.approx(1.0 / 20.0)


def test_functions_of_one_argument_at_one_site_are_said_to_be_seen_as_their_sum_alone():
    dry, curve = made_candidate("a"), made_candidate("b", "table")
    (note,) = shared_arguments([dry, curve])
    assert note.startswith("coulomb and table are functions of v at der(v): the data show their")
    assert shared_arguments([dry]) == ()
    elsewhere = replace(curve, effect=replace(curve.effect, variables=("x",)))
    assert shared_arguments([dry, elsewhere]) == ()
