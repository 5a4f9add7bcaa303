"""A result saves, reports and exports itself, and says what to know about it."""

import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ConfigError, ProblemError, RunFolderError
from workers.fmu.description import describe

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"


@pytest.fixture(scope="module")
def result():
    return ce.fit(spring_problem(experiments=2, samples=80, noise=0.002).problem, seed=3)


def same(one: pa.Table, other: pa.Table) -> bool:
    """Whether tables are equal, NaN being equal to NaN."""
    return one.schema == other.schema and repr(one.to_pylist()) == repr(other.to_pylist())


def test_a_saved_run_is_that_of_the_command(tmp_path):
    by_command = tmp_path / "command"
    assert main(["fit", str(CONFIG), "--no-report", "--out", str(by_command)]) == 0
    found = ce.fit(ce.read_problem(CONFIG))
    saved = found.save(tmp_path / "run")
    for name in found.tables:
        mine, theirs = (pq.read_table(at / f"{name}.parquet") for at in (saved, by_command))
        assert same(mine, theirs), name
    mine, theirs = (json.loads((at / "run.json").read_text()) for at in (saved, by_command))
    assert mine.keys() == theirs.keys()
    for name in mine.keys() - {"started", "seconds", "config_hash", "config_folder"}:
        different = name in ("reset_policy", "sensitivities")  # only a run says how it was chosen
        assert different or mine[name] == theirs[name], name
    assert list(found.notes) == mine["notes"]
    assert found.facts()["status"] == mine["status"] == "done"


def test_commands_read_what_was_saved(result, tmp_path, capsys):
    saved = result.save(str(tmp_path / "run"))
    assert json.loads((saved / "run.json").read_text())["seed"] == 3
    assert main(["show", str(saved)]) == 0
    assert f"{result.x['m']:.6g}" in capsys.readouterr().out
    assert main(["report", str(saved)]) == 0
    assert (saved / "report.html").stat().st_size > 10_000
    assert main(["export", str(saved), "--text"]) == 2
    assert "was saved from Python and has no config" in capsys.readouterr().err


def test_nothing_is_replaced_unless_asked(result, tmp_path):
    saved = result.save(tmp_path / "run")
    with pytest.raises(RunFolderError, match="holds a run already"):
        result.save(saved)
    assert result.save(saved, overwrite=True) == saved
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    with pytest.raises(RunFolderError, match="must be new or empty but holds other files"):
        result.save(tmp_path / "other", overwrite=True)
    with pytest.raises(ProblemError, match="folder: must be a path but is 3"):
        result.save(3)


def test_a_report_is_one_file(result, tmp_path):
    path = result.report(tmp_path / "springs.html")
    assert [each.name for each in tmp_path.iterdir()] == ["springs.html"]
    assert "springs" in path.read_text(encoding="utf-8")
    with pytest.raises(RunFolderError, match="must be written but cannot be"):
        result.report(tmp_path / "none" / "springs.html")


def test_an_export_has_the_estimates(result, tmp_path):
    found = result.export(tmp_path / "fitted.fmu", modelica=False, text=True, experiment="e1")
    assert found.files == (tmp_path / "fitted.fmu",)
    assert f"{result.x['m']:.5g}" in found.printed[0]
    exported = describe("fitted.fmu", (tmp_path / "fitted.fmu").read_bytes())
    assert exported.variables["m"].start == pytest.approx(result.x["m"])
    assert exported.variables["x"].start == pytest.approx(result.x["x0[e1]"])


@pytest.mark.parametrize(
    ("given", "kind", "said"),
    [
        ({}, ConfigError, "must be told what to write"),
        ({"fmu": "fitted.txt"}, ConfigError, "must end in .fmu but is 'fitted.txt'"),
        ({"text": True, "experiment": "e9"}, RunFolderError, "must be an experiment of the run"),
        ({"fmu": 3}, ProblemError, "fmu: must be a path but is 3"),
    ],
)
def test_an_export_that_cannot_be(result, given, kind, said):
    with pytest.raises(kind, match=said):
        result.export(**given)
