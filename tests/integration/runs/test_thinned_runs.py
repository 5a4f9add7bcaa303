"""Runs whose records are thinned: resumed, replayed, designed after, and said beforehand."""

import shutil
from pathlib import Path

import pytest
from support.cut_logs import cut
from support.designs import designed, limits_text
from support.run_folders import (
    SPRING,
    evaluations,
    facts,
    facts_without_clocks,
    leave_as_killed,
    tables,
)
from support.run_folders import rows as rows_of

from cluster_est.cli import main
from cluster_est.run_folder.log_segment import read_log

THIN = "thinning.rows=100"
QUICK = ["closed_loop.trials=4", "closed_loop.refits=2", "closed_loop.draws=200"]
SAMPLES = 500


def run(command: str, out: Path, *arguments: str) -> int:
    return main([command, SPRING, "--out", str(out), "--no-report", THIN, *arguments])


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("thinned") / "loop"
    assert run("close-loop", out, *QUICK) == 0
    return out


def test_a_loop_on_thinned_records_reports_on_all_rows(loop):
    assert any(note.startswith("long records are thinned from") for note in facts(loop)["notes"])
    assert {row["samples"] for row in rows_of(loop, "errors")} == {SAMPLES}


def test_it_is_resumed(loop, tmp_path):
    again = Path(shutil.copytree(loop, tmp_path / "run"))
    leave_as_killed(again)
    cut(again / "evaluations", int(0.3 * read_log(loop / "evaluations").num_rows))
    assert run("close-loop", again, "--resume", *QUICK) == 0
    assert tables(again) == tables(loop)
    assert facts_without_clocks(again) == facts_without_clocks(loop)
    assert evaluations(again) == evaluations(loop)


def test_its_simulations_are_replayed_on_the_rows_that_they_had(loop, capfd):
    searches = read_log(loop / "evaluations")["search"].to_pylist()
    for number in (searches.index("base"), searches.index("final")):
        assert main(["replay", str(loop), str(number)]) == 0
        said = capfd.readouterr().out
        assert "not the same as in the run" not in said
        assert "residuals agree with the logged ones bit for bit" in said


def test_the_next_experiment_is_designed_after_it(loop, tmp_path):
    text = limits_text(tail="[signals.y]\nlower = -1.0\nupper = 1.0")
    copy = Path(shutil.copytree(loop, tmp_path / "loop"))
    assert designed(copy, tmp_path / "next.csv", text, "--no-report") == 0
    assert (tmp_path / "next.csv").is_file()


def test_a_sensitivity_analysis_is_done_and_replayed_on_thinned_records(tmp_path, capfd):
    out = tmp_path / "run"
    assert run("sensitivity", out) == 0
    assert "long records are thinned from" in capfd.readouterr().err
    assert main(["replay", str(out), "0"]) == 0
    assert "residuals agree with the logged ones bit for bit" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (100, "for a fit and other steps, long records are thinned from 500 to 78-143 rows:"),
        ('"auto"', "for close-loop, sensitivity and design, long records are thinned from"),
        ('"no"', ""),
    ],
)
def test_a_check_says_what_will_be_done(rows, expected, capsys, monkeypatch):
    monkeypatch.setattr("cluster_est.problem.thinning.MOST_ROWS", 100)
    assert main(["check", SPRING, f"thinning.rows={rows}"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert expected in said
    assert ("a parabola is fitted in each block" in said) is bool(expected)


def test_a_check_says_that_effects_are_looked_for_in_parts(capsys, monkeypatch):
    monkeypatch.setattr("cluster_est.problem.thinning.MOST_ROWS", 30)
    assert main(["check", SPRING]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "still have more than 60 rows: close-loop looks for effects in a part of each" in said
