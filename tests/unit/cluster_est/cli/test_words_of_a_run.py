import json
import re
from math import nan

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.reported import Page

from cluster_est.cli import main
from cluster_est.html_report.activity import FailureGroup, LogActivity
from cluster_est.html_report.page import write_report
from cluster_est.problem.display import BETTER, NO_ALTERNATIVE

PARAMETER = {
    "label": "k", "value": 1.0, "start": 2.0, "lower": 0.0, "upper": 9.0, "lower95": 0.9,
    "upper95": 1.1, "value_before": 2.0, "lower95_before": 1.9, "upper95_before": 2.1, "unit": "N",
    "estimated_on": "train", "at_bound": "",
}  # fmt: skip
ERROR = {
    "experiment": "a", "role": "train", "output": "y", "samples": 100, "unit": "m",
    "rmse_before": 2.0, "rmse_after": 1.0, "normalised_before": 4.0, "normalised_after": 2.0,
    "relative_before": 0.4, "relative_after": 0.2,
}  # fmt: skip
NOISELESS = ERROR | {"normalised_before": nan, "normalised_after": nan}
LOST = NOISELESS | {"rmse_before": nan, "rmse_after": nan, "relative_after": nan}
EMPTY = LOST | {"experiment": "b", "samples": 0, "relative_before": nan}
FIT = {
    "status": "done", "cost_before": 4.0, "cost": 3.0, "iterations": 3, "evaluations": 9,
    "simulations": 100, "failures": 0, "seconds": 1.0, "message": "", "notes": [],
}  # fmt: skip
LOOP = FIT | {
    "verdict": "found", "summary": "", "effects": [], "errors_over": "estimated noise",
    "errors": {}, "rejected": [], "noise": {}, "sites": [], "failures_in_search": 0,
}  # fmt: skip
EFFECT = {
    "name": "square_v", "family": "stiffness", "site": "der(v)", "form": "square",
    "variables": ["v"], "equation": "der(v) += k * v^2", "alternatives": [], "evidence": [],
    "words": "drag", "sentence": "Drag at der(v): der(v) += k * v^2.", "also": [],
    "config": "", "parameters": {
        "k": {"value": -0.35, "unit": "1/m", "fixed": False, "at_bound": "", "lower95": None,
              "upper95": None},
    },
}  # fmt: skip
SAME = {
    "words": "curve", "form": "table", "site": "der(v)", "equation": "der(v) += table",
    "criterion": 1.0, "experiment": "a", "output": "y", "time": 1.0, "difference": 0.0,
}  # fmt: skip


@pytest.fixture
def stored(tmp_path):
    """Write a run folder."""

    def write(facts, parameters=(PARAMETER,), errors=(ERROR,)):
        for name, rows in (("parameters", parameters), ("errors", errors)):
            pq.write_table(pa.Table.from_pylist([*rows]), tmp_path / f"{name}.parquet")
        (tmp_path / "run.json").write_text(json.dumps(facts))
        return tmp_path

    return write


@pytest.fixture
def printed(stored, capsys):
    def show(facts, **tables):
        assert main(["show", str(stored(facts, **tables))]) == 0
        return capsys.readouterr().out

    return show


@pytest.fixture
def page(stored):
    def show(facts, activity=None, **tables):
        text = Page(write_report(stored(facts, **tables), activity=activity)).text
        return text.replace("\u2009", " ")

    return show


def test_words_and_sentence_stand_for_the_equation(printed, page):
    facts = LOOP | {"effects": [EFFECT]}
    said = printed(facts)
    assert "effect square_v (drag) at der(v)" in said
    assert "  Drag at der(v): der(v) += k * v^2." in said
    assert "stiffness" not in said
    shown = page(facts)
    assert "Found: drag at der(v)" in shown
    assert "der(v) += k * v^2" in shown


def test_effects_and_leads_say_how_often_such_were_right(printed, page):
    sure = "place and law are right with a probability of 92 %: of 54 similar claims, 51 were right"
    lead = "this is a lead, not a claim: of 75 leads in the benchmark, 12 were right"
    found = LOOP | {"effects": [EFFECT | {"claim": {"sentence": sure}}]}
    assert f"  {sure}" in printed(found)
    assert f"P{sure[1:]}." in page(found)
    doubtful = LOOP | {"verdict": "partial", "effects": [EFFECT | {"claimed": False}]}
    assert "lead square_v (drag) at der(v)" in printed(doubtful)
    assert "Found in part: drag at der(v) (a lead)" in page(doubtful)
    unexplained = {"verdict": "unexplained", "rejected": [EFFECT | {"claim": {"sentence": lead}}]}
    assert f"der(v) += k * v^2; {lead}" in printed(LOOP | unexplained)
    assert f"T{lead[1:]}." in page(LOOP | unexplained)


def test_how_often_leads_were_right_is_said_once(printed, page):
    lead = "this is a lead, not a claim: of 75 leads in the benchmark, 12 were right"
    other = EFFECT | {"site": "der(w)", "equation": "der(w) += k * w^2"}
    rejected = [each | {"claim": {"sentence": lead}} for each in (EFFECT, other)]
    for summary in ("the model lacks something", f"best guess: drag: for each effect, {lead}"):
        facts = LOOP | {"verdict": "unexplained", "summary": summary, "rejected": rejected}
        for said in (printed(facts), page(facts)):
            assert said.lower().count(lead[:60]) == 1
            assert "der(w) += k * w^2" in said


LEAD, AT_BOUND = EFFECT | {"claimed": False}, PARAMETER | {"at_bound": "lower"}
LEFT, NEAR = ERROR, ERROR | {"normalised_after": 1.1}


@pytest.mark.parametrize(
    ("facts", "row", "steps", "others"),
    [
        ({"effects": [EFFECT]}, NEAR, ["Export the repaired"], ["Check ", "Look for"]),
        ({"effects": [LEAD], "verdict": "partial"}, NEAR,
         ["Check square at der(v) by a test or an inspection before you rely on it: it is only a"],
         ["Export", "Look for"]),
        ({"effects": [LEAD, EFFECT], "verdict": "partial"}, LEFT,
         ["Check square at der(v) by", "Export the repaired", "Look for the places"], []),
        ({"effects": [LEAD, LEAD | {"variables": ["u"]}], "verdict": "partial"}, LEFT,
         ["Check square at der(v) and square(u) at der(v) by a test",
          "on them: they are only leads", "Look for the places"],
         ["Export"]),
        ({"verdict": "unexplained"}, LEFT, ["Look for the places"], ["Export", "search again"]),
        ({"verdict": "unexplained", "first": "correct the records"}, LEFT,
         ["Correct the records as the summary says, and search again."], ["Look for", "Widen"]),
        ({"effects": [EFFECT], "first": "set inputs.u"}, NEAR,
         ["Set inputs.u as the summary says"], ["Export"]),
    ],
)  # fmt: skip
def test_next_steps_fit_the_verdict(printed, facts, row, steps, others):
    said = printed(LOOP | facts | {"errors": {}}, errors=[row], parameters=[AT_BOUND])
    told = said[said.index("next: ") :]
    assert all(step in told for step in steps)
    assert not any(other in told for other in others)


def test_bounds_of_a_lead_are_not_widened(printed):
    facts = LOOP | {"verdict": "partial", "effects": [LEAD]}
    own = AT_BOUND | {"label": "square_v.n"}
    assert "Widen the bounds of k," in printed(facts, parameters=[AT_BOUND, own])
    assert "Widen" not in printed(facts, parameters=[PARAMETER, own])
    claimed = facts | {"effects": [EFFECT]}
    assert "Widen the bounds of square_v.n," in printed(claimed, parameters=[PARAMETER, own])


def test_a_lead_is_no_strong_evidence_against_other_candidates(printed, page):
    for claimed in (True, False):
        facts = LOOP | {"effects": [EFFECT | {"claimed": claimed}]}
        assert (NO_ALTERNATIVE in printed(facts)) is claimed
        assert (NO_ALTERNATIVE in page(facts)) is claimed


@pytest.mark.parametrize("key", ["nested", "same_law"])
def test_the_same_law_in_other_words_is_neither_a_rival_nor_excluded(printed, page, key):
    """It has a further coefficient that is too small to be seen, or is written in another way."""
    facts = LOOP | {"effects": [EFFECT | {"alternatives": [SAME | {key: True}]}]}
    for said in (printed(facts), page(facts)):
        assert "curve at der(v)" not in said
        assert NO_ALTERNATIVE not in said
        assert "from its rivals" not in said
    assert "from its rivals" in printed(LOOP | {"effects": [EFFECT | {"alternatives": [SAME]}]})


@pytest.mark.parametrize(("noise", "said"), [(0.5, False), (0.4, True)])
def test_a_noise_that_the_errors_are_not_divided_by_is_told_apart(printed, noise, said):
    """The errors of y are 1 m, which is 2 times the noise of the declared model."""
    text = printed(LOOP | {"effects": [EFFECT], "noise": {"y": noise}})
    assert f"noise estimated from the residuals with the effects: y {noise}" in text
    assert (
        "the errors are divided by the noise estimated without the effects: y 0.5" in text
    ) is said


def test_an_alternative_without_an_equation_and_with_other_parameters(printed, page):
    other = SAME | {"equation": "", "parameters": "k = 1.6 instead of 2.1 N/m"}
    facts = LOOP | {"effects": [EFFECT | {"alternatives": [other]}]}
    assert "from: curve at der(v); with it, k = 1.6 instead of 2.1 N/m (crit" in printed(facts)
    assert "curve at der(v) (with it, k = 1.6 instead of 2.1 N/m)" in page(facts)


def test_a_rival_that_fits_better_is_said_to_do_so(printed, page):
    for better in (True, False):
        other = SAME | {"criterion": -12.3, "better": better}
        facts = LOOP | {"effects": [EFFECT | {"alternatives": [other]}]}
        assert (f"(criterion -12.3; {BETTER})" in printed(facts)) is better
        assert (BETTER in page(facts)) is better


def test_a_rival_without_numbers_is_named_alone(printed, page):
    nothing = dict.fromkeys(("criterion", "time", "difference"), None)
    facts = LOOP | {"effects": [EFFECT | {"alternatives": [SAME | nothing | {"experiment": ""}]}]}
    said = printed(facts)
    assert "from: curve at der(v): der(v) += table\n" in said
    assert "nothing in these data" not in said
    assert "curve at der(v)" in page(facts)


@pytest.mark.parametrize(
    ("difference", "advice"),
    [(0.0, "nothing in these data distinguishes them"), (3.0, "where they differ most")],
)
def test_nobody_is_told_to_dwell_where_nothing_differs(printed, difference, advice):
    effect = EFFECT | {"alternatives": [SAME | {"difference": difference}]}
    said = printed(LOOP | {"effects": [effect]})
    assert advice in said
    assert "0 times" not in said


def test_a_coefficient_at_its_bound_is_not_said_to_be_undetermined(printed):
    held = EFFECT["parameters"]["k"] | {"at_bound": "lower"}
    said = printed(LOOP | {"effects": [EFFECT | {"parameters": {"k": held}}]})
    assert "95 %: at its lower bound" in said
    assert "not determined" not in said


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (ERROR, ["2", "1", "m", "4", "2"]),
        (NOISELESS, ["2", "1", "m", "unknown", "unknown"]),
        (LOST, ["failed", "failed", "m", "failed", "failed"]),
        (EMPTY, ["m"]),
    ],
    ids=["known", "without noise", "lost", "without samples"],
)
def test_only_a_simulation_that_failed_is_said_to_have_failed(printed, row, words):
    said = printed(LOOP | {"noise": {"y": None}}, errors=[row])
    (line,) = re.findall(rf"^{row['experiment']}  .*$", said, re.MULTILINE)
    assert line.split()[4:] == words
    assert "noise estimated from the residuals: y unknown" in said


@pytest.mark.parametrize(
    ("facts", "narrow"),
    [
        (LOOP | {"verdict": "unexplained"}, True),
        (LOOP, False),
        (FIT | {"residuals": {"too_narrow": True}}, True),
        (FIT | {"residuals": {"too_narrow": False}}, False),
    ],
)
def test_intervals_do_not_allow_for_what_is_missing(printed, page, facts, narrow):
    coefficient = EFFECT["parameters"]["k"] | {"lower95": -0.4, "upper95": -0.3}
    if "effects" in facts:
        facts = facts | {"effects": [EFFECT | {"parameters": {"k": coefficient}}]}
        assert ("95 % (too narrow): -0.4 .. -0.3" in printed(facts)) is narrow
    assert ("95 % interval (too narrow)" in printed(facts)) is narrow
    assert ("95 % interval (too narrow)" in page(facts)) is narrow


@pytest.mark.parametrize(
    ("tried", "in_terminal", "on_page"),
    [
        ({"failures_in_search": 0}, "7 failed)", "7 of 100 simulations failed (7.00 %)."),
        (
            {"failures_in_search": 7},
            "7 failed, all of them in the search for effects",
            "all of them in the search",
        ),
        (
            {"failures_in_search": 5},
            "7 failed, 5 of them in the search for effects",
            "5 of them in the search",
        ),
    ],
)
def test_failures_of_effects_only_tried_are_called_so(printed, page, tried, in_terminal, on_page):
    facts = LOOP | {"failures": 7} | tried
    assert in_terminal in printed(facts)
    assert on_page in page(facts)


@pytest.mark.parametrize(
    ("logged", "failures", "said"), [((0, 0), 7, "7"), ((50, 2), 7, "2"), ((0, 0), 0, "none")]
)
def test_failures_of_a_run_without_a_log_are_not_forgotten(page, logged, failures, said):
    """A run that was saved from Python has none."""
    simulations, failed = logged
    groups = (FailureGroup("timeout", "late", failed, 0, ("a",)),) if failed else ()
    none = np.zeros(0)
    activity = LogActivity(simulations, ("w",), none.astype(int), none, none, groups)
    text = page(LOOP | {"failures": failures}, activity)
    assert f"{said} failed" in text
    assert ("simulations failed (" in text) is (said != "none")


@pytest.mark.parametrize(
    ("status", "said"), [("interrupted", "not simulated"), ("failed", "failed")]
)
def test_what_was_not_simulated_did_not_fail(printed, status, said):
    parameter = PARAMETER | {"lower95": nan, "upper95": nan}
    text = printed(
        FIT | {"status": status, "cost": nan},
        parameters=[parameter],
        errors=[ERROR | {"rmse_after": nan, "relative_after": nan}],
    )
    assert f"cost 4 -> {said} in 3 iterations" in text
    assert re.search(rf"2 +{said} +m", text)
    assert "nan" not in text
    assert ("not determined" in text) is (status == "failed")


def errors(before, after):
    return [ERROR | {"normalised_before": before, "normalised_after": after}]


@pytest.mark.parametrize(
    ("facts", "errors", "said"),
    [
        (LOOP, errors(1.5, 1.5), "The error is 1.50 times the estimated noise on training exp"),
        (LOOP, errors(1.5, 1.2), "The error fell from 1.50 to 1.20 times"),
        (LOOP, errors(1.2, 1.5), "The error rose from 1.20 to 1.50 times"),
        (LOOP, errors(nan, 1.5), "The error is 1.50 times"),
        (
            LOOP | {"cost": 4.0},
            [ERROR],
            "was 4.000 after the fit of the declared model and is 4.000.",
        ),
        (FIT | {"cost": 4.0}, [ERROR], "The cost was 4.000 at the start values and is 4.000."),
        (LOOP | {"cost": 2.0}, [ERROR], "declared model and is 2.000: a factor of 2.00 lower."),
        (LOOP | {"cost": 8.0}, [ERROR], "declared model and is 8.000: a factor of 2.00 higher."),
    ],
)
def test_what_stays_has_not_fallen(page, facts, errors, said):
    assert said in page(facts, errors=errors)


def test_an_experiment_without_samples_hides_no_error_and_has_not_failed(page):
    text = page(LOOP, errors=[ERROR, EMPTY])
    assert "fell from 4.00 to 2.00 times" in text
    assert "y training 2.00 1.00 m 2.00 20.0 %" in text
    assert text.count("failed") == 1  # none of the simulations
    assert "none failed" in text
    lost = page(LOOP, errors=[ERROR | {"rmse_after": nan, "normalised_after": nan}])
    assert lost.count("failed") > 1


@pytest.mark.parametrize("width", [30, 50, 80, 200])
def test_a_terminal_gets_whole_words_and_an_indent(printed, monkeypatch, width):
    """A file gets one line."""
    sentence = "Coulomb friction at der(v): der(v) += -k * tanh(v / width), with k = 0.5015 m/s^2"
    (whole,) = re.findall(r"verdict: .*\n", printed(LOOP | {"summary": sentence}))
    assert whole == f"verdict: found: {sentence}\n"
    for name, value in (("FORCE_COLOR", "1"), ("NO_COLOR", "1"), ("COLUMNS", str(width))):
        monkeypatch.setenv(name, value)
    text, _ = re.split(r"\n(?=run )", printed(LOOP | {"summary": sentence}))
    lines = text.split("\n")
    assert all(len(line) <= width for line in lines)
    assert " ".join(text.split()) == whole.rstrip()
    assert all(line.startswith(" " * 4) for line in lines[1:])
    assert (len(lines) == 1) is (width == 200)
