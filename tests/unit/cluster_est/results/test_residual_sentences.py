"""What is said of residuals, and as which facts."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from cluster_est.results.residual_sentences import residual_facts, residual_sentences
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


@pytest.mark.parametrize(
    ("output", "said", "not_said"),
    [
        (
            MISSING,
            (
                "y: error is 3 x sigma and autocorrelated at lag 1 with 0.9",
                "these intervals are too narrow, something is missing from the model",
                "cluster-est close-loop CONFIG --out FOLDER",
                "close_loop(problem)",
            ),
            "coloured",
        ),
        (
            RELATED,
            (
                "autocorrelated at lag 1 with 0.8 though hardly larger than sigma (1 x)",
                "noise is coloured, which the intervals allow for, or something small is missing",
            ),
            "from the model",
        ),
        (
            replace(RELATED, declared=False, rms_over_sigma=0.06, noise_over_sigma=0.02),
            (
                "error is 3 x its noise from sample to sample (0.02; no sigma is declared)",
                "or the sensor's noise is coloured",
            ),
            "x sigma",
        ),
        (
            replace(RELATED, lag1=0.02, length=60.0),
            ("autocorrelated over about 60 samples (lag 1: 0.02)",),
            "at lag 1 with",
        ),
        (
            replace(FINE, rms_over_sigma=10.0, noise_over_sigma=10.0, sigma=SigmaDoubt.TOO_SMALL),
            ("10 x sigma but white", "sigma is probably 10 times too small"),
            "close-loop",
        ),
        (
            replace(FINE, rms_over_sigma=0.1, noise_over_sigma=0.1, sigma=SigmaDoubt.TOO_LARGE),
            ("error is 0.1 x sigma", "sigma is probably 10 times too large"),
            "close-loop",
        ),
        (
            replace(FINE, largest_over_rms=9.0, sigma=SigmaDoubt.OUTLIERS),
            ("the largest is 9 times", "outliers", "huber"),
            "intervals",
        ),
        (
            replace(RELATED, rms_over_sigma=12.0, noise_over_sigma=9.0, sigma=SigmaDoubt.TOO_SMALL),
            ("1.3 x its noise from sample to sample and", "alone is 9 x sigma: the declared sigma"),
            "error is 12 x sigma",
        ),
    ],
)
def test_each_finding_has_its_words(output, said, not_said):
    text = "\n".join(residual_sentences(ResidualDiagnostics((output,))))
    for part in said:
        assert part in text
    assert not_said not in text


def test_nothing_is_said_where_nothing_is_wrong():
    found = ResidualDiagnostics((FINE, replace(FINE, output="z")))
    assert residual_sentences(found) == ()
    assert residual_facts(found)["too_narrow"] is False


def test_outputs_share_a_sentence_and_the_worst_come_first():
    outputs = [replace(MISSING, output=f"y{i}", rms_over_sigma=2.0 + i) for i in range(7)]
    (text,) = residual_sentences(ResidualDiagnostics((*outputs, FINE)))
    assert text.startswith("y6: error is 8 x sigma")
    assert "y3: " in text
    assert "y2: " not in text
    assert "and 3 more outputs" in text


def test_a_search_that_did_not_converge_is_a_reason_too():
    found = ResidualDiagnostics((MISSING,), converged=False)
    assert "the search did not converge, or something is missing" in residual_sentences(found)[0]


def test_facts_have_the_figures():
    together = replace(RELATED, output="all outputs together")
    facts = residual_facts(ResidualDiagnostics((MISSING, FINE), together))
    assert json.loads(json.dumps(facts))["outputs"][0]["structure"] == "something is missing"
    assert facts["together"]["lag1"] == 0.8
    assert facts["too_narrow"] is True
    assert facts["sentences"] == list(residual_sentences(ResidualDiagnostics((MISSING, FINE))))
