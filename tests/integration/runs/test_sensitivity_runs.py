from pathlib import Path

import pytest
from support.problems.springs import ROOT
from support.run_folders import facts, rows

from cluster_est.cli import main

CONFIG = str(ROOT / "configs" / "mass_with_friction.toml")


def ranked(out: Path, *arguments: str) -> int:
    return main(["sensitivity", CONFIG, "--out", str(out), *arguments])


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ranked") / "run"
    assert ranked(folder) == 0
    return folder


def test_the_stiffness_of_a_spring_matters_most(run, capsys):
    assert main(["show", str(run)]) == 0
    printed = capsys.readouterr().out.splitlines()
    first = printed.index(next(line for line in printed if line.startswith("parameter"))) + 1
    assert [line.split()[0] for line in printed[first : first + 3]] == ["k", "c", "m"]
    assert "mu* of log(cost)" in printed[first - 1]
    assert facts(run)["status"] == "done"
    assert sorted(facts(run)["sensitivity"]["together"]) == ["c", "k", "m"]


def test_every_output_has_indices_over_time(run):
    table = rows(run, "indices")
    times = {row["time"] for row in table if row["output"] == "y" and row["experiment"] == "exp1"}
    assert len(times) == 20
    assert {row["experiment"] for row in table} == {"", "exp1", "exp2", "exp3"}


def test_its_report_shows_the_ranking_and_the_outputs(run):
    page = (run / "report.html").read_text(encoding="utf-8")
    ranked = [row["label"] for row in rows(run, "ranking")]
    assert f"The cost depends most on {ranked[0]}, then {' and '.join(ranked[1:3])}" in page
    assert "estimated together" in page
    assert "Mean absolute elementary effect of log(cost)" in page
    assert "Mean absolute elementary effect of y in exp1" in page


@pytest.mark.parametrize(
    "command",
    [["export", "RUN", "--text"], ["simulate", CONFIG, "--run", "RUN", "--out", "values.csv"]],
)
def test_it_has_no_estimates_to_go_on_with(run, command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([str(run) if part == "RUN" else part for part in command]) == 2
    said = capsys.readouterr().err
    assert "is a folder of sensitivity analysis, which has no estimates" in said


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ("parameters.k.bounds=[0.0, 90.0]", "parameters.k.bounds: must be bounds above 0"),
        ("parameters.c.bounds=[0.0, inf]", "parameters.c.bounds: must be finite bounds"),
        ("sensitivity.method=fast", "sensitivity.method"),
        ("sensitivity.groups=-3", "sensitivity.groups"),
    ],
)
def test_what_cannot_be_sampled_is_refused_in_a_sentence(changed, sentence, tmp_path, capsys):
    assert ranked(tmp_path / "never", changed) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "never").exists()
