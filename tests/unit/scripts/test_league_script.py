import json
import math
import re
import tomllib
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from measured_league.cases import (
    CONVERSIONS,
    all_cases,
    changed,
    convert,
    official_cases,
    textbook_config,
    with_logarithm,
)
from measured_league.page import (
    CaseJudgements,
    Judgement,
    Rightness,
    claims_wrong,
    made_worse,
    named,
    near_textbook,
    page_text,
    read_judgements,
    says_so,
)
from measured_league.runs import (
    CaseFigures,
    LoopFigures,
    NamedEffect,
    RunFigures,
    effect_name,
    pooled,
    read_case,
)

from cluster_est.config.reader import parse_config

CASES = {case.name: case for case in all_cases()}


@pytest.mark.parametrize("name", sorted(CASES))
def test_textbook_is_fitted_to_the_same_split(name):
    case = CASES[name]
    base = parse_config(tomllib.loads(case.config.read_text(encoding="utf-8")), name)
    textbook = parse_config(tomllib.loads(textbook_config(case)), name)
    assert len(base.experiments) == len(textbook.experiments)
    for own, other in zip(base.experiments, textbook.experiments, strict=True):
        assert own.model_dump(exclude={"values"}) == other.model_dump(exclude={"values"})
    assert {each.role for each in base.experiments} == {"train", "test"}
    more = {*textbook.parameters} - {*base.parameters}
    assert textbook.effects or more, "the textbook must add something"
    assert not base.effects
    assert all(each.startswith(("$", ".")) for each in base.data_folders), "of no machine"


def test_every_case_has_words_for_the_page():
    official = {case.name for case in official_cases()}
    assert set(read_judgements()) == {*CASES, *official}
    assert all(text.endswith(".") for case in CASES.values() for text in (case.title, case.lacking))


def test_a_change_joins_tables_by_name_and_experiments_by_id():
    base = {
        "parameters": {"k": {"start": 1.0, "scale": "log"}},
        "experiments": [{"id": "a", "values": {"x": 1.0}}, {"id": "b"}],
    }
    change = {
        "parameters": {"k": {"start": 2.0}, "c": {"start": 3.0}},
        "experiments": [{"id": "a", "values": {"y": 2.0}}],
    }
    assert changed(base, change) == {
        "parameters": {"k": {"start": 2.0, "scale": "log"}, "c": {"start": 3.0}},
        "experiments": [{"id": "a", "values": {"x": 1.0, "y": 2.0}}, {"id": "b"}],
    }
    with pytest.raises(ValueError, match="the base lacks"):
        changed(base, {"experiments": [{"id": "c"}]})


def test_conversions_leave_repeated_times_out_and_take_logarithms(tmp_path):
    assert [row[1] for row in with_logarithm([["time", "V"], ["0", "1000"]])] == ["lgV", "3.0"]
    before, (after, _) = next(iter(CONVERSIONS.items()))
    file = tmp_path / "data" / before
    file.parent.mkdir(parents=True)
    file.write_text("time,V\n0,1\n0,1\n1,2\n", encoding="utf-8")
    (written,) = convert(tmp_path / "data", tmp_path / "out")
    assert written == tmp_path / "out" / after
    assert written.read_text(encoding="utf-8") == "time,V\n0,1\n1,2\n"


def test_errors_are_pooled_over_samples_not_over_records():
    rows = [
        {"role": "test", "samples": 3, "rmse_after": 1.0},
        {"role": "test", "samples": 1, "rmse_after": 5.0},
        {"role": "train", "samples": 9, "rmse_after": 7.0},
    ]
    assert pooled(rows, "test") == pytest.approx(math.sqrt((3.0 + 25.0) / 4.0))
    assert math.isnan(pooled([], "test"))


def test_the_first_pattern_counts_and_the_best_name_decides():
    right = Judgement("coulomb at der(v) of *", Rightness.RIGHT, "rubs")
    wrong = Judgement("* at der(v) of *", Rightness.WRONG, "does not")
    known = CaseJudgements("", (right, wrong))
    rubs = effect_name("coulomb", "der(v)", ["v"])
    assert known.of(rubs).why == "rubs"
    assert known.of(effect_name("cubic", "der(v)", ["v"])).rightness is Rightness.WRONG
    assert known.of("bias at output y").rightness is Rightness.OPEN
    assert known.overall(["cubic at der(v) of v", rubs]) is Rightness.RIGHT
    assert known.overall(["cubic at der(v) of v", "bias at output y"]) is Rightness.OPEN
    assert known.overall([]) is None


def figures(test: float, effects: tuple[NamedEffect, ...] = (), verdict: str = "none"):
    """A made-up case: base 1 / 2, textbook 0.1 / 0.1, noise 0.1, and a loop with an error."""
    base, textbook = RunFigures(1.0, 2.0, "m", 9, 1.0), RunFigures(0.1, 0.1, "m", 9, 1.0)
    loop = LoopFigures(RunFigures(0.1, test, "m", 1234, 56.0), verdict, effects)
    return CaseFigures(CASES["rocket"], base, textbook, loop, 0.1)


DRAG = NamedEffect("quadratic at der(v) of v", "der(v) += -k * v * abs(v)")


def test_questions_of_the_summary():
    assert near_textbook(figures(0.105))
    assert not near_textbook(figures(0.106))
    assert made_worse(figures(2.1, (DRAG,)))
    assert not made_worse(figures(2.1))
    assert says_so(figures(0.2, (DRAG,), "partial"))
    assert not says_so(figures(0.2, (DRAG,), "found"))
    assert not says_so(figures(0.1, (DRAG,), "partial"))


def with_lead(error: float, lead: NamedEffect = DRAG):
    """The made-up case with a textbook fit of this error, and a loop that only has a lead."""
    each = figures(2.0)
    assert each.loop is not None
    textbook = RunFigures(0.1, error, "m", 9, 1.0)
    return replace(each, textbook=textbook, loop=replace(each.loop, leads=(lead,)))


@pytest.mark.parametrize(
    ("error", "counts"), [(1.2, True), (0.9, False)], ids=["closes 64 %", "closes 80 %"]
)
def test_a_lead_counts_where_the_textbook_effect_is_too_small_to_be_added(error, counts):
    judgements = read_judgements()
    each = with_lead(error)
    assert named(each, judgements) is counts
    assert ("| right (lead) |" in page_text([each], judgements, {})) is counts


@pytest.mark.parametrize(("probability", "wrong"), [(0.6, True), (0.4, False)])
def test_only_an_effect_that_is_more_likely_right_than_wrong_is_a_wrong_claim(probability, wrong):
    false = Judgement(DRAG.name, Rightness.WRONG, "flies in a vacuum")
    each = figures(0.1, (replace(DRAG, probability=probability),), "partial")
    assert claims_wrong(each, CaseJudgements("", (false,))) is wrong
    text = page_text([each], {"rocket": CaseJudgements("", (false,))}, {})
    assert ("| 60% | physically wrong |" in text) is wrong
    assert ("| 40% (lead) | physically wrong |" in text) is not wrong


def test_the_page_has_every_case_with_its_figures_and_words():
    text = page_text([figures(0.1, (DRAG,), "found")], read_judgements(), {"rocket": "a/b.svg"})
    assert "| [rocket](#rocket) | m | 1 / 2 | 0.1 / 0.1 | 0.1 / 0.1 | 0.1 | found | right |" in text
    assert "| 1234 | 56 |" in text
    assert "| right | air drag |" in text
    assert "](a/b.svg)" in text
    assert "| the loop increased the held-out error | 0 of 1 |" in text
    alone = CaseFigures(CASES["ur5e"], None, None, None, math.nan)
    assert "Some runs have not ended for these cases: ur5e." in page_text([alone], {}, {})


def searched(name: str, path: dict[tuple[str, ...], float], answer: float) -> CaseFigures:
    """The made-up case with another name, and a loop with these held-out errors."""
    each = figures(0.1, (DRAG,), "partial")
    assert each.loop is not None
    loop = replace(each.loop, path=path, answer=answer)
    return replace(each, case=CASES[name], loop=loop)


def test_the_page_has_held_out_errors_along_each_path_and_how_far_answers_are_from_the_least():
    nan = math.nan
    found = [
        searched("emps", {(): 80.0, ("a",): 20.0, ("a", "b"): 10.0, ("b", "c"): 12.0}, 12.0),
        searched("furuta", {(): 8.0, ("a",): nan, ("a", "b"): 4.0}, 3.9),  # the last fit is better
        searched("house", {(): 9.0, ("a",): 3.0}, 9.0),  # a veto
        searched("rocket", {(): 2.0}, 2.0),
        searched("tclab", {(): nan, ("a",): nan}, nan),
        CaseFigures(CASES["ur5e"], None, None, None, nan),
    ]
    text = page_text(found, read_judgements(), {})
    steps = "base model: 80; + `a`: 20; + `b`: 10; - `a` + `c`: 12"
    assert f"| emps | {steps} | 12 | 1.2 |" in text
    assert "| furuta | base model: 8; + `a`: -; + `b`: 4 | 3.9 | 1 |" in text
    assert "| house | base model: 9; + `a`: 3 | 9 | 3 |" in text
    assert all(f"| {name} | - | - | - |" in text for name in ("rocket", "tclab", "ur5e"))
    said = "Over 3 cases, .* 1.2 times .* \\(median\\), and 3 times in the worst case \\(house\\)"
    assert re.search(said, text)
    assert "nothing is chosen by held-out errors. The held-out data can only veto" in text
    assert "along the path" not in page_text(found[3:], read_judgements(), {})


def written_run(folder, structures, errors):
    """Write the files of a loop that the page reads."""
    folder.mkdir(parents=True)
    named = ("effects", "accepted", "left_out", "held_out")
    rows = [dict(zip(named, row, strict=True)) for row in structures]
    pq.write_table(pa.Table.from_pylist(rows), folder / "structures.parquet")
    row = {"role": "test", "experiment": "e", "samples": 1, "rmse_after": 1.0, "unit": "m"}
    pq.write_table(pa.Table.from_pylist([row]), folder / "errors.parquet")
    run = {"status": "done", "simulations": 1, "seconds": 1.0, "verdict": "partial"}
    facts = run | {"effects": [], "rejected": [], "noise": {}, "errors": {"test": errors}}
    (folder / "run.json").write_text(json.dumps(facts), encoding="utf-8")


def test_a_path_has_the_base_model_and_all_that_was_accepted_but_nothing_else(tmp_path):
    nan = math.nan
    structures = [
        (["a"], True, nan, nan),  # compared again below
        (["x"], False, nan, nan),
        (["a", "b"], True, 0.2, 5.0),
        (["a"], False, 0.3, 7.0),
        (["a", "b", "c"], False, 0.4, 6.0),  # accepted, but not the answer
        (["a", "c"], True, nan, nan),  # what remained after an effect was dropped
    ]
    written_run(tmp_path / "emps" / "loop", structures, {"before": 9.0, "after": 5.5})
    loop = read_case(CASES["emps"], tmp_path).loop
    assert loop is not None
    known = {(): 9.0, ("a",): 7.0, ("a", "b"): 5.0, ("a", "b", "c"): 6.0}
    assert list(loop.path) == [*known, ("a", "c")]
    assert {own: loop.path[own] for own in known} == known
    assert math.isnan(loop.path["a", "c"])
    assert loop.answer == 5.5
    assert loop.over_least == pytest.approx(1.1)


def test_a_loop_without_held_out_data_has_no_ratio(tmp_path):
    structures = [(["a"], True, 0.3, math.nan)]
    written_run(tmp_path / "emps" / "loop", structures, {"before": None, "after": None})
    loop = read_case(CASES["emps"], tmp_path).loop
    assert loop is not None
    assert math.isnan(loop.over_least)
