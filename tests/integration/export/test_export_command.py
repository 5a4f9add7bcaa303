"""`cluster-est export` as a user runs it, behind a fit."""

from __future__ import annotations

import json
import shutil
from importlib.resources import files
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fmpy import extract, read_model_description
from fmpy.validation import validate_fmu
from lxml import etree
from support.exported import Exported, co_simulated, needs_compiler

from cluster_est.cli import main
from cluster_est.cli.exit_codes import ExitCode

CONFIGS = Path(__file__).parents[3] / "configs"
EFFECT = """
[[effects]]
name = "harder"
site = "der(v)"
form = "cubic"
variables = ["x"]
parameters = { k = { start = 1.0 } }
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A fit of the embedded example with an effect, in a folder with its config and data."""
    base = tmp_path_factory.mktemp("run")
    (base / "models").mkdir()
    shutil.copy(CONFIGS / "models" / "mass_spring_damper.fmu", base / "models")
    shutil.copytree(CONFIGS / "data" / "mass_spring_damper", base / "data" / "mass_spring_damper")
    text = (CONFIGS / "mass_spring_damper.toml").read_text(encoding="utf-8")
    (base / "config.toml").write_text(text + EFFECT, encoding="utf-8")
    assert main(["fit", str(base / "config.toml"), "--out", str(base / "run")]) == ExitCode.DONE
    return base / "run"


def rows_of(run, table):
    return pq.read_table(run / f"{table}.parquet").to_pylist()


@needs_compiler
def test_the_exported_fmu_does_what_the_run_did(run, tmp_path, capsys):
    fmu = tmp_path / "repaired.fmu"
    assert main(["export", str(run), "--fmu", str(fmu), "--experiment", "exp5"]) == ExitCode.DONE
    assert validate_fmu(str(fmu)) == []
    found = {row["label"]: row["value"] for row in rows_of(run, "parameters")}
    starts = {v.name: v.start for v in read_model_description(str(fmu)).modelVariables}
    for name, label in [("m", "m"), ("x", "x0[exp5]"), ("harder.k", "harder.k")]:
        assert float(starts[name]) == found[label]
    data = np.genfromtxt(
        run.parent / "data" / "mass_spring_damper" / "exp5.csv", delimiter=",", names=True
    )
    truth = [r["simulated"] for r in rows_of(run, "trajectories") if r["experiment"] == "exp5"]
    exported = Exported(Path(extract(str(fmu), str(tmp_path / "unpacked"))))
    exported.begin({"F": data["force"][0]}, data["time"][0])
    result = co_simulated(exported, data["time"], {"F": data["force"]}, "y")
    exported.close()
    np.testing.assert_allclose(result, truth, rtol=0.0, atol=1e-6)


@needs_compiler
def test_a_fit_without_effects_reproduces_the_cost(run, tmp_path):
    fmu = run.parent / "models" / "repaired.fmu"
    assert main(["export", str(run), "--fmu", str(fmu)]) == ExitCode.DONE
    text = (run.parent / "config.toml").read_text(encoding="utf-8").replace(EFFECT, "")
    text = text.replace("mass_spring_damper.fmu", "repaired.fmu")
    found = {row["label"]: row["value"] for row in rows_of(run, "parameters")}
    for name, start in [("m", "1.0"), ("k", "25.0"), ("c", "0.8")]:
        text = text.replace(f"{name} = {{ start = {start}", f"{name} = {{ start = {found[name]!r}")
    text = text.replace("x0 = { start = 0.0", f"x0 = {{ start = {found['x0[exp5]']!r}")
    (run.parent / "again.toml").write_text(text, encoding="utf-8")
    assert (
        main(["fit", str(run.parent / "again.toml"), "--out", str(tmp_path / "again")])
        == ExitCode.DONE
    )
    facts = [json.loads((folder / "run.json").read_text()) for folder in (run, tmp_path / "again")]
    assert facts[1]["cost_before"] == pytest.approx(facts[0]["cost"], rel=1e-9)
    assert facts[1]["cost"] == pytest.approx(facts[0]["cost"], rel=1e-6)


def test_the_parameter_set_satisfies_the_schema_of_the_standard(run, tmp_path):
    path = tmp_path / "values.ssv"
    assert main(["export", str(run), "--ssv", str(path), "--experiment", "exp5"]) == ExitCode.DONE
    schema = files("fmpy.ssp") / "schema" / "SystemStructureParameterValues.xsd"
    tree = etree.parse(str(path))
    etree.XMLSchema(etree.parse(str(schema))).assertValid(tree)
    space = {"ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues"}
    values = {
        each.get("name"): (float(each[0].get("value")), each[0].get("unit"))
        for each in tree.findall(".//ssv:Parameter", space)
    }
    found = {row["label"]: row["value"] for row in rows_of(run, "parameters")}
    assert values["m"] == (found["m"], "kg")
    assert values["x"] == (found["x0[exp5]"], "m")
    assert values["harder.k"][0] == found["harder.k"]


def test_equations_for_a_modeller(run, capsys):
    assert main(["export", str(run), "--modelica", "--text"]) == ExitCode.DONE
    said = " ".join(capsys.readouterr().out.split())
    assert 'parameter Real harder_k(unit="' in said
    assert '"95 %: ' in said
    assert "harder_at_v = -harder_k*x^3;" in said
    assert "// add harder_at_v to the right side of der(v)" in said
    assert "harder (drag) at der(v) der(v) += -k * x^3" in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "must be told what to write; add --fmu"),
        (["--fmu", "no/such/a.fmu"], "--fmu: must be in a folder that exists but no/such does not"),
        (["--ssv", "no/a.ssv"], "--ssv: must be in a folder that exists but no does not; make it"),
        (["--ssv", "values.xml"], "must end in .ssv but is 'values.xml'"),
        (["--text", "--experiment", "exp6"], "must be an experiment of the run but is 'exp6'"),
        (["--text", "--config", "nowhere.toml"], "there is no config file nowhere.toml"),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(run, capsys, arguments, sentence):
    assert main(["export", str(run), *arguments]) == ExitCode.BAD_INPUT
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_the_original_is_never_written_over(run, capsys):
    original = run.parent / "models" / "mass_spring_damper.fmu"
    before = original.read_bytes()
    assert main(["export", str(run), "--fmu", str(original)]) == ExitCode.BAD_INPUT
    assert "must be another file than the original FMU" in capsys.readouterr().err
    assert original.read_bytes() == before


def test_values_of_a_run_with_an_effect_are_not_simulated_without_it(run, tmp_path, capsys):
    config, out = run.parent / "plain.toml", tmp_path / "curves.csv"
    text = (run.parent / "config.toml").read_text(encoding="utf-8")
    config.write_text(text.replace(EFFECT, ""), encoding="utf-8")
    assert (
        main(["simulate", str(config), "--out", str(out), "--run", str(run)]) == ExitCode.BAD_INPUT
    )
    assert "has harder.k besides; add the run's [[effects]]" in capsys.readouterr().err
    assert not out.exists()


def test_shared_values_alone_are_said_to_be_so(run, capsys):
    assert main(["export", str(run), "--text"]) == ExitCode.DONE
    said = " ".join(capsys.readouterr().err.split())
    assert "x0 has a value for each experiment and keeps its start" in said


def test_an_fmu_that_has_changed_is_refused(run, tmp_path, capsys):
    for name in ("run", "models", "data"):
        shutil.copytree(run.parent / name, tmp_path / name)
    shutil.copy(run.parent / "config.toml", tmp_path)
    shutil.copy(CONFIGS / "models" / "dc_motor.fmu", tmp_path / "models" / "other.fmu")
    other = (CONFIGS / "models" / "mass_spring_damper.fmu").read_bytes() + b"\0"
    (tmp_path / "models" / "mass_spring_damper.fmu").write_bytes(other)
    arguments = ["export", str(tmp_path / "run"), "--text", "--config"]
    assert main([*arguments, str(tmp_path / "config.toml")]) == ExitCode.BAD_INPUT
    assert "must be the FMU that the run was made with" in " ".join(capsys.readouterr().err.split())


def test_without_a_compiler_there_is_a_sentence(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CC", "no-such-compiler")
    assert main(["export", str(run), "--fmu", str(tmp_path / "a.fmu")]) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "CC must name a C compiler but is 'no-such-compiler'" in said
    assert not (tmp_path / "a.fmu").exists()
