"""What is said of residuals and errors, and as which facts."""

import json
import math
import re
from dataclasses import replace

import pytest
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.statistics.residual_findings import (
    OutputDiagnostics,
    ResidualDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)

FINE = OutputDiagnostics(
    output="y",
    samples=500,
    declared=True,
    rms_over_sigma=1.0,
    noise_over_sigma=1.0,
    largest_over_rms=3.0,
    lag1=0.01,
    widening=1.0,
    p=0.5,
    length=6.0,
    structure=ResidualStructure.WHITE,
    sigma=SigmaDoubt.NONE,
)
MISSING = replace(FINE, rms_over_sigma=3.0, lag1=0.9, p=1e-9, structure=ResidualStructure.MISSING)
RELATED = replace(FINE, lag1=0.8, widening=3.0, structure=ResidualStructure.AUTOCORRELATED)


@pytest.fixture(scope="module")
def result():
    """Of which nothing is to be said."""
    found = ce.fit(spring_problem(experiments=2, samples=80, noise=0.002).problem)
    assert found.notes == ()
    return found


@pytest.fixture
def noted(result):
    """Gives the notes on some residuals."""

    def give(*outputs, **how):
        return replace(result, diagnostics=ResidualDiagnostics(outputs, **how)).notes

    return give


@pytest.mark.parametrize(
    ("output", "said", "not_said"),
    [
        (
            MISSING,
            "y: error is 3 x sigma.*autocorrelated at lag 1 with 0.9.*intervals are too narrow, "
            "something is missing.*close-loop CONFIG --out FOLDER.*close_loop.problem",
            "coloured",
        ),
        (
            RELATED,
            "autocorrelated at lag 1 with 0.8.*hardly larger than sigma .1 x.*coloured, which the "
            "intervals allow for, or something small is missing",
            "from the model",
        ),
        (
            replace(RELATED, declared=False, rms_over_sigma=0.06, noise_over_sigma=0.02),
            "error is 3 x its noise.*0.02; no sigma is declared.*or the sensor's noise is coloured",
            "x sigma",
        ),
        (
            replace(RELATED, lag1=0.02, length=60.0),
            "autocorrelated over about 60 samples .lag 1: 0.02",
            "at lag 1 with",
        ),
        (
            replace(FINE, rms_over_sigma=10.0, noise_over_sigma=10.0, sigma=SigmaDoubt.TOO_SMALL),
            "10 x sigma but white.*sigma is probably 10 times too small",
            "close-loop",
        ),
        (
            replace(FINE, rms_over_sigma=0.1, noise_over_sigma=0.1, sigma=SigmaDoubt.TOO_LARGE),
            "error is 0.1 x sigma.*sigma is probably 10 times too large",
            "close-loop",
        ),
        (
            replace(FINE, largest_over_rms=9.0, sigma=SigmaDoubt.OUTLIERS),
            "the largest is 9 times.*outliers.*huber",
            "intervals",
        ),
        (
            replace(RELATED, rms_over_sigma=12.0, noise_over_sigma=9.0, sigma=SigmaDoubt.TOO_SMALL),
            "1.3 x its noise.*alone is 9 x sigma.*sigma is probably 9 times too small",
            "error is 12 x sigma",
        ),
    ],
)
def test_each_finding_has_its_words(noted, output, said, not_said):
    text = " ".join(noted(output))
    assert re.search(said, text)
    assert not_said not in text


def test_nothing_is_said_where_nothing_is_wrong(noted):
    assert noted(FINE, replace(FINE, output="z")) == ()


def test_outputs_share_a_sentence_and_the_worst_come_first(noted):
    outputs = [replace(MISSING, output=f"y{i}", rms_over_sigma=2.0 + i) for i in range(7)]
    (text,) = noted(*outputs, FINE)
    assert re.match("y6: error is 8 x sigma.*y3: .*and 3 more outputs", text)
    assert "y2: " not in text


def test_a_search_that_did_not_converge_is_a_reason_too(noted):
    (text,) = noted(MISSING, converged=False)
    assert "did not converge, or something is missing" in text


def test_facts_have_the_figures(result):
    found = ResidualDiagnostics((MISSING, FINE), replace(RELATED, output="all outputs together"))
    facts = json.loads(json.dumps(replace(result, diagnostics=found).facts()))["residuals"]
    assert facts["outputs"][0]["structure"] == "something is missing"
    assert facts["together"]["lag1"] == 0.8
    assert facts["too_narrow"] is True
    assert facts["sentences"] == list(replace(result, diagnostics=found).notes)
    assert result.facts()["residuals"]["too_narrow"] is False


def test_an_output_that_a_constant_would_follow_better_is_named_once_with_its_worst(result):
    def error(experiment, output, relative, role="train"):
        return replace(
            result.errors[0],
            experiment=experiment,
            output=output,
            relative_after=relative,
            role=role,
        )

    errors = (
        error("a", "T", 1.5),
        error("b", "T", 5.91),
        error("a", "p", 0.99),
        error("a", "level", math.inf),  # a constant was measured
        error("a", "flow", math.nan),
        error("c", "p", 7.0, role="test"),
    )
    bad = replace(result, errors=errors)
    (note,) = bad.notes
    assert re.search("a constant would follow T better.*in b is 5.91 times", note)
    assert bad.facts()["notes"] == [note]
