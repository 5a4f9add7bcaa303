import math
import tomllib

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
    made_worse,
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


def test_the_page_has_every_case_with_its_figures_and_words():
    text = page_text([figures(0.1, (DRAG,), "found")], read_judgements(), {"rocket": "a/b.svg"})
    assert "| [rocket](#rocket) | m | 1 / 2 | 0.1 / 0.1 | 0.1 / 0.1 | 0.1 | found | right |" in text
    assert "| 1234 | 56 |" in text
    assert "| right | air drag |" in text
    assert "](a/b.svg)" in text
    assert "| the loop increased the held-out error | 0 of 1 |" in text
    alone = CaseFigures(CASES["ur5e"], None, None, None, math.nan)
    assert "Some runs have not ended for these cases: ur5e." in page_text([alone], {}, {})
