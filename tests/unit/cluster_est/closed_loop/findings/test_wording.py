import math
from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_fit,
    made_fitter,
    made_problem,
    made_refit,
    made_result,
    made_round,
    made_screening,
    made_selection,
)
from support.named_effects import estimate
from support.problems.springs import spring_problem

from cluster_est import Effect, LoopResult, Parameter
from cluster_est.closed_loop.findings.alternatives import contains
from cluster_est.closed_loop.findings.description import (
    describe_effects,
    error_changes,
    shared_arguments,
    where_left,
)
from cluster_est.closed_loop.findings.effects import ErrorChange, Verdict
from cluster_est.closed_loop.screening.screen import CandidateEvidence
from cluster_est.closed_loop.settings import CandidateStage
from cluster_est.html_report.number_text import percent
from cluster_est.problem.display import in_percent
from cluster_est.results.output_errors import OutputError
from workers.effects.forms import FORMS


def followed(problem, rmse, sigma):
    """A result in which an output is followed with this error."""
    error = OutputError(
        experiment="run 0", role="train", output="y0", unit="m", samples=50,
        rmse_before=9.0, rmse_after=rmse, relative_before=9.0, relative_after=9.0,
        normalised_before=9.0, normalised_after=rmse / sigma,
    )  # fmt: skip
    return made_result(problem, [error])


def change(sigma, noise, before=0.6, after=0.2):
    """The row of these errors with this sigma and this noise, both in units of y0."""
    problem = made_problem(50, sigma=sigma)
    fitted = fit_with_squares(problem, 1.0)
    last = made_round(None, made_screening(fitted.jacobian, fitted.residuals, [], []))
    found = made_selection(fitted, fitted, last, noise=[noise / sigma])
    fits = (followed(problem, rmse, sigma) for rmse in (before, after))
    (row,) = error_changes(made_fitter(problem), found, *fits)
    return row


@pytest.mark.parametrize(
    ("sigma", "noise", "expected"),
    [
        pytest.param(0.5, 0.1, (1.2, 0.4), id="the given sigma"),
        pytest.param(1.0, 0.1, (6.0, 2.0), id="the noise"),
        pytest.param(1.0, 0.0, (np.nan, np.nan), id="no noise"),
        pytest.param(1.0, np.nan, (np.nan, np.nan), id="unknown noise"),
    ],
)
def test_errors_are_over_the_given_sigma_or_else_over_the_noise(sigma, noise, expected):
    row = change(sigma, noise)
    assert (row.experiment, row.role, row.output, row.unit) == ("run 0", "train", "y0", "m")
    assert (row.samples, row.rmse_before, row.rmse_after) == (50, 0.6, 0.2)
    found = row.normalised_before, row.normalised_after
    assert found == pytest.approx(expected, nan_ok=True)


def test_an_experiment_that_could_not_be_simulated_before_counts_after():
    row = change(0.5, 0.5, before=np.nan, after=2.0)
    assert np.isnan(row.normalised_before)
    assert row.normalised_after == pytest.approx(4.0)


def alternatives(scale=1.0, rival=None, known=()):
    """Of an effect and a rival, whose predictions differ in training and held-out experiments."""
    problem = made_problem(50, 50, 50, outputs=2, roles=("train", "test", "train"))
    fits = []
    for name, moved in (("a", 0.0), ("b", scale)):
        residuals = np.zeros(200)
        residuals[10] = -8.0 * moved  # first experiment, y0
        residuals[150 + 49] = 2.0 * moved  # second training experiment, y1, last sample
        added = made_candidate(name) if rival is None or name == "a" else rival
        own = tuple(Parameter(f"{name}.{c.name}", 0.5) for c in added.form.coefficients)
        grown = replace(problem, effects=(added.effect,), parameters=(*problem.parameters, *own))
        fits.append(made_fit(grown, residuals, [added]))
    won, lost = (
        made_refit(fit, criterion) for fit, criterion in zip(fits, (5.0, 8.0), strict=True)
    )
    last = made_round(None, made_screening(won.fitted.jacobian, np.zeros(200), [], []))
    found = made_selection(won.fitted, won.fitted, last, noise=[4.0, 0.5])
    found = replace(found, rivals={"a": (won, [lost])})
    result = replace(made_result(problem, []), estimates=tuple(known))
    (effect,) = describe_effects(made_fitter(problem), found, result)
    return effect.alternatives


def test_an_alternative_says_where_it_differs_most_for_the_noise():
    """The larger difference is in y0, whose noise is larger still; the test run counts not."""
    (found,) = alternatives()
    assert (found.site, found.form, found.family) == ("der(v)", "coulomb", "friction")
    assert found.words == "Coulomb friction"
    assert found.criterion == 3.0
    assert (found.experiment, found.output) == ("run 2", "y1")
    assert (found.time, found.difference) == pytest.approx((1.0, 4.0))


def test_what_the_data_tell_apart_at_some_sample_is_no_alternative():
    assert alternatives(scale=3.0) == ()


@pytest.mark.parametrize(
    ("value", "upper", "said"),
    [
        (2.5, 2.6, "k = 1 instead of 2.5 N/m"),
        (1.1, 1.3, ""),  # inside of the interval
        (2.5, math.nan, ""),
    ],
)
def test_an_alternative_names_the_parameters_that_it_changes(value, upper, said):
    """With both effects, k was fitted to 1; the last fit has this value and interval."""
    known = replace(
        estimate("k", value, "N/m"), label="k", parameter="k", lower95=2 * value - upper,
        upper95=upper,
    )  # fmt: skip
    (found,) = alternatives(known=[known])
    assert found.parameters == said


def law_at_v(name, form):
    made = FORMS["derivative", form]
    count = len(made.coefficients)
    return replace(
        made_candidate(name), effect=Effect(name, "der(v)", form, ("v",)), form=made,
        grid=((0.0,) * count,), lowest=(-1.0,) * count, highest=(1.0,) * count,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "rival", "nested"),
    [
        ("linear", "delayed", True),
        ("viscous", "lagged", True),
        ("square", "lagged", False),
        ("delayed", "linear", False),
    ],
)
def test_the_same_law_with_a_time_that_nobody_can_see_is_no_rival(found, rival, nested):
    assert contains(law_at_v("b", rival), law_at_v("a", found)) is nested
    elsewhere = replace(law_at_v("a", found), effect=Effect("a", "der(v)", found, ("x",)))
    assert not contains(law_at_v("b", rival), elsewhere)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_a_delay_has_no_equation_as_a_rival(scale):
    (found,) = alternatives(scale, law_at_v("b", "delayed"))
    assert (found.words, found.equation) == ("a term in the delayed v", "")


def accepted(step, form, criterion):
    return CandidateEvidence(
        step, "der(v)", form, "friction", ("v",), 9.0, 1, -9.0, 0.3, 1.0, CandidateStage.ACCEPTED,
        criterion,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ((1, 2), "of the residual; the criterion falls by 500"),
        ((1, 1), "of the residual; with all effects of this step together, the criterion falls"),
    ],
)
def test_effects_that_were_added_together_share_one_fall_of_the_criterion(steps, said):
    fit = made_fit(made_problem(50), np.zeros(50), [made_candidate("a")])
    last = made_round(None, made_screening(fit.jacobian, fit.residuals, [], []))
    rows = [accepted(steps[0], "coulomb", -500.0), accepted(steps[1], "viscous", -500.0)]
    found = replace(made_selection(fit, fit, last), findings=tuple(rows))
    problem = made_problem(50)
    (effect,) = describe_effects(made_fitter(problem), found, made_result(problem, []))
    assert said in effect.evidence[0]


@pytest.mark.parametrize(
    ("part", "decimals", "said"),
    [
        (0.43, 0, "43%"), (0.9988, 0, "99.9%"), (0.9999, 0, "99.99%"), (0.999999, 1, "more than"),
        (1.0, 0, "100%"), (1.3, 0, "130%"), (0.0, 0, "0%"), (0.9996, 1, "99.96%"),
    ],
)  # fmt: skip
def test_a_part_is_never_said_to_be_all(part, decimals, said):
    assert in_percent(part, decimals).startswith(said)
    shown = percent(part).replace("\u2009", "")
    assert part >= 1.0 or float(shown.removeprefix("more than ").rstrip("%")) < 100.0


def test_an_output_without_samples_in_an_experiment_is_passed_over():
    runs = made_problem(50, 50, outputs=2).experiments
    nothing = np.zeros(0)
    shorter = replace(runs[0].outputs[1], times=nothing, values=nothing)
    runs = (replace(runs[0], outputs=(runs[0].outputs[0], shorter)), runs[1])
    problem = replace(made_problem(50, 50, outputs=2), experiments=runs)
    residuals = np.ones(150)
    residuals[-1] = 30.0
    said = where_left(made_fitter(problem), made_fit(problem, residuals))
    assert "output y1 of experiment 'run 1'" in said


@pytest.mark.parametrize(
    ("residuals", "said"),
    [
        (np.random.default_rng(4).standard_normal(400), "spread evenly over all experiments"),
        (np.zeros(400), "there is no remaining error"),
    ],
    ids=["evenly", "nothing"],
)
def test_no_part_is_named_where_none_stands_out(residuals, said):
    problem = made_problem(200, 200)
    found = where_left(made_fitter(problem), made_fit(problem, residuals))
    assert said in found
    assert "run" not in found


def test_where_and_when_most_of_a_residual_lives():
    problem = made_problem(100, 100)
    residuals = np.ones(200)
    residuals[100 + 41 : 100 + 44] = 10.0
    said = where_left(made_fitter(problem), made_fit(problem, residuals))
    assert "output y0 of experiment 'run 1'" in said
    assert f" s: {302 / (197 + 300):.0%} of the squared error is in 2.5% of the samples" in said
    start, stop = (float(x) for x in said.split("t = ")[1].partition(" s:")[0].split(" and "))
    times = problem.experiments[1].outputs[0].times
    assert start <= times[41] < times[43] <= stop
    assert stop - start == pytest.approx(1.0 / 20.0)


def test_functions_of_one_argument_at_one_site_are_said_to_be_seen_as_their_sum_alone():
    dry, curve = made_candidate("a"), made_candidate("b", "table")
    (note,) = shared_arguments([dry, curve])
    assert note.startswith("coulomb and table are functions of the same variable, v, at der(v)")
    assert shared_arguments([dry]) == ()
    elsewhere = replace(curve, effect=replace(curve.effect, variables=("x",)))
    assert shared_arguments([dry, elsewhere]) == ()


def result(*errors: ErrorChange) -> LoopResult:
    """A loop that ended with these errors."""
    fitted = made_result(spring_problem(experiments=1, samples=20).problem, ())
    return LoopResult(
        Verdict.PARTIAL, "", (), fitted, fitted, errors, (), (), {}, (), (), 0.0, 0, 0, 0, 0.0
    )


def of_experiment(experiment: str, before: float, after: float, samples: int = 100) -> ErrorChange:
    return ErrorChange(experiment, "train", "y", "m", samples, before, after, before, after)


def test_errors_before_and_after_are_of_the_same_experiments() -> None:
    lost, won = of_experiment("lost", 9.0, math.nan), of_experiment("won", math.nan, 5.0)
    found = result(of_experiment("both", 3.0, 1.0), lost, won)
    assert found.rms("train", "before") == 3.0
    assert found.rms("train", "after") == 1.0
