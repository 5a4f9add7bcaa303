from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_problem, made_result
from support.named_effects import estimate

from cluster_est.closed_loop.findings.claim_evidence import doubted
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.methods.method import Ending, Evaluation
from workers.messages import Outcome, Status

DONE = made_result(made_problem(50), ())
SLOW = replace(DONE, solution=replace(DONE.solution, ending=Ending.MAX_ITERATIONS))
FOUND = ReasonedVerdict(Verdict.FOUND, "the effect closes 99% of the gap")
DECLARED = replace(estimate("k", 9.0), label="k", parameter="k")
SHAPE = estimate("half", 31.0, "m")


def at_bound(*estimates):
    held = tuple(replace(each, at_bound="upper") for each in estimates)
    return replace(DONE, estimates=held)


@pytest.mark.parametrize(
    ("after", "cause"),
    [
        (
            at_bound(SHAPE),
            "half of saturation at input u at its upper bound, 31 m. At a bound",
        ),
        (at_bound(DECLARED), "k at its upper bound, 9: an effect may compensate for a value"),
        (SLOW, "last fit of the model with the effects did not converge"),
    ],
    ids=["shape at its end", "declared parameter at its bound", "not converged"],
)
def test_what_is_in_doubt_bars_found_and_is_named(after, cause):
    judged, said = doubted(FOUND, {"e": "saturation at input u"}, DONE, after)
    assert judged.verdict is Verdict.PARTIAL
    assert judged.reason.startswith(FOUND.reason)
    assert cause in judged.reason
    assert said == ()
    lower = replace(FOUND, verdict=Verdict.PARTIAL)
    same, (sentence,) = doubted(lower, {"e": "saturation at input u"}, DONE, after)
    assert same is lower
    assert cause in sentence


def test_without_doubts_what_was_found_stays_found():
    known = replace(DONE, estimates=(SHAPE, DECLARED))
    assert doubted(FOUND, {"e": "saturation at input u"}, DONE, known) == (FOUND, ())


def test_each_cause_is_named_apart():
    judged, _ = doubted(FOUND, {"e": "saturation at input u"}, DONE, at_bound(SHAPE, DECLARED))
    _, declared, shape = judged.reason.split(". ", maxsplit=2)
    assert declared.startswith("The fit with the effects ends with k at its upper bound")
    assert shape.startswith("The fit ends with half of saturation at input u at its upper bound")


def test_a_fit_of_the_declared_model_alone_bars_nothing_that_was_found():
    judged, said = doubted(FOUND, {"e": "saturation at input u"}, SLOW, DONE)
    assert judged is FOUND
    assert said[0].startswith("the last fit of the declared model did not converge")


@pytest.mark.parametrize(("errors", "verdict"), [(0.7, Verdict.FOUND), (3.0, Verdict.PARTIAL)])
def test_a_fit_that_ends_within_a_standard_error_of_its_minimum_is_good_enough(errors, verdict):
    """Of 50 residuals of size 1 and one unknown; that it did not converge is said all the same."""
    residuals = np.tile([1.0, -1.0], 25)
    column = np.ones((50, 1)) / np.sqrt(50.0)
    seen = Outcome(0, Status.OK, residuals + errors * column[:, 0])
    at = Evaluation((seen,), 1.0)
    solution = replace(SLOW.solution, jacobian=column, at=at)
    judged, said = doubted(
        FOUND, {"e": "saturation at input u"}, DONE, replace(SLOW, solution=solution)
    )
    assert judged.verdict is verdict
    sentence = said[0] if verdict is Verdict.FOUND else judged.reason.split(". ", maxsplit=1)[1]
    assert sentence.lower().startswith(
        "the last fit of the model with the effects did not converge"
    )


def test_where_nothing_was_added_bounds_are_no_doubt_of_an_effect():
    none = ReasonedVerdict(Verdict.NONE, "")
    assert doubted(none, {}, DONE, at_bound(DECLARED)) == (none, ())
