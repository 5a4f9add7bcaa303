import json
import math
import re
from dataclasses import replace

import pytest
from support.problems.seen_springs import with_outputs
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.preflight.all_checks import run_checks
from cluster_est.statistics.residual_findings import (
    OutputDiagnostics,
    ResidualDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)

FINE = OutputDiagnostics(
    output="y", samples=500, declared=True, rms_over_sigma=1.0, noise_over_sigma=1.0,
    largest_over_rms=3.0, lag1=0.01, widening=1.0, p=0.5, length=6.0,
    structure=ResidualStructure.WHITE, sigma=SigmaDoubt.NONE,
)  # fmt: skip
MISSING = replace(FINE, rms_over_sigma=3.0, lag1=0.9, p=1e-9, structure=ResidualStructure.MISSING)
RELATED = replace(FINE, lag1=0.8, widening=3.0, structure=ResidualStructure.AUTOCORRELATED)


@pytest.fixture(scope="module")
def result():
    """Of which nothing is to be said."""
    found = ce.fit(spring_problem(experiments=3, samples=80, noise=0.002).problem)
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
        (MISSING,
         "y: error is 3 x sigma.*autocorrelated at lag 1 with 0.9.*something is missing from the "
         "model, so these intervals are too narrow.*use cluster-est close-loop.*"
         "close_loop.problem", "coloured"),
        (RELATED,
         "autocorrelated at lag 1 with 0.8.*hardly larger than sigma .1 x.*coloured .the "
         "intervals allow for that., or something small is missing", "from the model"),
        (replace(RELATED, declared=False, rms_over_sigma=0.06, noise_over_sigma=0.02),
         "error is 3 x its noise.*no sigma is declared.*or the sensor noise is coloured",
         "x sigma"),
        (replace(RELATED, lag1=0.02, length=60.0),
         "autocorrelated over about 60 samples .lag 1: 0.02", "at lag 1 with"),
        (replace(FINE, rms_over_sigma=10.0, noise_over_sigma=10.0, sigma=SigmaDoubt.TOO_SMALL),
         "10 x sigma but white.*sigma is probably 10 times too small", "close-loop"),
        (replace(FINE, rms_over_sigma=0.1, noise_over_sigma=0.1, sigma=SigmaDoubt.TOO_LARGE),
         "error is 0.1 x sigma.*sigma is probably 10 times too large", "close-loop"),
        (replace(FINE, largest_over_rms=9.0, sigma=SigmaDoubt.OUTLIERS),
         "the largest is 9 times.*outliers.*huber", "intervals"),
        (replace(RELATED, rms_over_sigma=12.0, noise_over_sigma=9.0, sigma=SigmaDoubt.TOO_SMALL),
         "1.3 x its noise.*noise is about 9 times the declared sigma.*multiply it by 9 ",
         "error is 12 x sigma"),
    ],
)  # fmt: skip
def test_each_finding_has_its_words(noted, output, said, not_said):
    text = " ".join(noted(output))
    assert re.search(said, text)
    assert not_said not in text


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
        changes = {"experiment": experiment, "output": output, "relative_after": relative}
        return replace(result.errors[0], role=role, **changes)

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
    assert re.search("a constant would fit T better.*in b is 5.91 times", note)
    assert bad.facts()["notes"] == [note]


NOISE = 0.002
TRUTH = spring_problem(noise=NOISE)
STARTS = {f"e{e}": TRUTH.values[f"x0[e{e}]"] for e in range(5)}


def at_the_truth(**starts):
    """The springs from their true parameters; initial positions only as they are given."""
    parameters = [ce.Parameter(name, value, (0.0, 100.0)) for name, value in TRUE.items()]
    if starts:
        parameters.append(ce.Parameter("x", 0.0, (-1.0, 1.0), fixed=True))
    runs = tuple(
        replace(run, values=(("x", starts[run.id]),) if run.id in starts else ())
        for run in TRUTH.problem.experiments
    )
    model = replace(TRUTH.problem.model, parameters=tuple(p.target for p in parameters))
    problem = replace(TRUTH.problem, model=model, parameters=tuple(parameters), experiments=runs)
    return with_outputs(problem, lambda output: replace(output, sigma=NOISE))


def said_of(problem, fitted):
    """What a fit says of the starts, or a check before it; the truth is a spring's closed form."""
    if fitted:
        notes = ce.fit(problem).notes
    else:
        page = run_checks(problem, ce.Resources(executor="local"), 60.0)
        notes = [f"{found.found}: {found.do}" for found in page.findings]
    return [note for note in notes if "in a different state from the model" in note]


@pytest.mark.parametrize(("fitted", "sigma"), [(False, NOISE), (True, NOISE), (True, 1.0)])
def test_a_spring_that_was_let_go_elsewhere_is_off_by_that_much(fitted, sigma):
    """A sigma of 1 is none: the noise is then that of the samples."""
    (said,) = said_of(with_outputs(at_the_truth(), lambda o: replace(o, sigma=sigma)), fitted)
    found = re.search(
        r"of 5 experiments begin .* y is off by up to (.*) m, (.*) times its noise", said
    )
    distance, over_noise = map(float, found.groups())
    assert distance == pytest.approx(max(map(abs, STARTS.values())), abs=4 * NOISE)
    assert over_noise == pytest.approx(distance / NOISE, rel=0.6)
    for state in "xv":
        assert f'parameters.{state} = {{ start = 0, per = "experiment" }}' in said
    assert "values.x = NUMBER" in said


@pytest.mark.parametrize(
    ("problem", "fitted"),
    [
        (at_the_truth(**STARTS), False),
        (at_the_truth(**STARTS), True),
        (TRUTH.problem, True),
        (at_the_truth(**STARTS | {"e0": STARTS["e0"] + 0.3}), True),
        (with_outputs(at_the_truth(**STARTS), lambda o: replace(o, values=o.values + 0.3)), True),
    ],
    ids=["right", "right, fitted", "estimated", "one of five", "an offset that stays"],
)
def test_where_the_starts_are_right_nothing_is_said(problem, fitted):
    assert said_of(problem, fitted) == []
