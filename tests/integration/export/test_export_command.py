"""`cluster-est export` as a user runs it, behind a fit."""

from __future__ import annotations

import csv
import json
import re
import shutil
import struct
import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fmpy import extract, read_model_description, simulate_fmu
from fmpy.validation import validate_fmu
from lxml import etree
from support.exported import Exported, co_simulated, needs_compiler

from cluster_est import build_problem, read_config
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
def test_a_fit_without_effects_reproduces_the_cost(run, tmp_path, capsys):
    fmu = run.parent / "models" / "repaired.fmu"
    assert main(["export", str(run), "--fmu", str(fmu)]) == ExitCode.DONE
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "x0 has a value for each experiment and keeps its start in the exported FMU (x0 = 0); "
        "choose the values of one with --experiment ID, in Python experiment=ID, of exp1, exp2, "
    ) in said
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


@needs_compiler
def test_the_fmu_says_which_step_reproduces_the_error_and_another_tool_finds_it(
    run, tmp_path, capsys
):
    fmu = tmp_path / "repaired.fmu"
    assert main(["export", str(run), "--fmu", str(fmu), "--experiment", "exp2"]) == ExitCode.DONE
    said = " ".join(capsys.readouterr().err.split())
    (named,) = re.findall(r"a communication step of (\S+) s reproduces the run's RMSE \(y: ", said)
    with zipfile.ZipFile(fmu) as archive:
        readme = archive.read("documentation/README.md").decode()
    assert f"a communication step of {named} s reproduces the run's RMSE" in readme
    assert "harder (cubic) at der(v)" in readme
    (shape,) = rows_of(run, "shapes")
    span = f"x from {min(shape['x']):.4g} to {max(shape['x']):.4g} m"
    assert f"estimated over {span}; beyond, a guess" in readme
    assert read_config(run / "config.toml").model.rtol is None  # what the solver then takes
    assert float(read_model_description(str(fmu)).defaultExperiment.tolerance) == 1e-8
    assert "the run had a relative tolerance of 1e-08" in " ".join(readme.split())
    errors = {row["experiment"]: row for row in rows_of(run, "errors")}
    for name, row in errors.items():
        sizes = f"{row['rmse_before']:.4g} | {row['rmse_after']:.4g}"
        assert f"| {name} | {'fitted' if row['role'] == 'train' else 'held out'} | y | m" in readme
        assert f"| {sizes} |" in readme
    step = float(read_model_description(str(fmu)).defaultExperiment.stepSize)
    assert step == pytest.approx(float(named), rel=1e-5)
    data = np.genfromtxt(
        run.parent / "data" / "mass_spring_damper" / "exp2.csv", delimiter=",", names=True
    )
    fed = np.array(
        list(zip(data["time"], data["force"], strict=True)), [("time", "f8"), ("F", "f8")]
    )

    def error(step):
        found = simulate_fmu(
            str(fmu), stop_time=data["time"][-1], step_size=step, output_interval=step,
            input=fed, output=["y"], fmi_type="CoSimulation",
            set_input_derivatives=False, record_events=False,
        )  # fmt: skip
        simulated = np.interp(data["time"], found["time"], found["y"])
        return np.sqrt(np.mean((data["position"] - simulated) ** 2))

    assert error(step) == pytest.approx(errors["exp2"]["rmse_after"], rel=0.05)
    assert error(0.02) > 1.2 * error(step)


@needs_compiler
def test_the_step_need_not_be_measured(run, tmp_path, capsys):
    fmu = tmp_path / "repaired.fmu"
    assert main(["export", str(run), "--fmu", str(fmu), "--no-step"]) == ExitCode.DONE
    assert "communication step" not in capsys.readouterr().err
    with zipfile.ZipFile(fmu) as archive:
        assert "It was not measured." in archive.read("documentation/README.md").decode()


@needs_compiler
def test_libraries_for_other_platforms(run, tmp_path):
    pytest.importorskip("ziglang")
    fmu = tmp_path / "everywhere.fmu"
    arguments = ["--fmu", str(fmu), "--no-step", "--platforms", "win64", "darwin64"]
    assert main(["export", str(run), *arguments]) == ExitCode.DONE
    name = "binaries/{}/mass_spring_damper_repaired.{}"
    with zipfile.ZipFile(fmu) as archive:
        windows = archive.read(name.format("win64", "dll"))
        mac = archive.read(name.format("darwin64", "dylib"))
        assert name.format("linux64", "so") in archive.namelist()
    assert windows[:2] == b"MZ"
    assert b"fmi2DoStep\0" in windows
    assert struct.unpack(">II", mac[:8]) == (0xCAFEBABE, 2)
    for part in range(2):
        processor, _, offset, size, _ = struct.unpack_from(">5I", mac, 8 + 20 * part)
        assert processor == (0x01000007, 0x0100000C)[part]
        assert mac[offset : offset + 4] == bytes.fromhex("cffaedfe")
        assert b"_fmi2DoStep\0" in mac[offset : offset + size]


@needs_compiler
def test_without_zig_there_is_a_sentence(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    arguments = ["--fmu", str(tmp_path / "a.fmu"), "--platforms", "win64"]
    assert main(["export", str(run), *arguments]) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "--platforms: needs the package ziglang to compile for win64" in said
    assert "`pip install 'cluster-est[export]'`" in said
    assert not (tmp_path / "a.fmu").exists()


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


@pytest.mark.parametrize("form", ["ssv", "csv"])
def test_the_values_of_a_run_are_the_starts_of_the_next(run, form):
    base = run.parent
    path = base / f"found.{form}"
    assert main(["export", str(run), f"--{form}", str(path), "--experiment", "exp5"]) == 0
    text = (base / "config.toml").read_text(encoding="utf-8")
    (base / f"next_{form}.toml").write_text(f'value_files = ["{path.name}"]\n{text}')
    config = read_config(base / f"next_{form}.toml")
    starts = {p.name: p.start for p in build_problem(config, base).parameters}
    found = {row["label"]: row["value"] for row in rows_of(run, "parameters")}
    for name, label in [("m", "m"), ("x0", "x0[exp5]"), ("harder.k", "harder.k")]:
        assert starts[name] == found[label]


def test_a_table_of_values_has_their_intervals(run, tmp_path):
    path = tmp_path / "values.csv"
    assert main(["export", str(run), "--csv", str(path), "--experiment", "exp5"]) == ExitCode.DONE
    with path.open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    found = {row["label"]: row for row in rows_of(run, "parameters")}
    assert float(rows["m"]["low"]) == found["m"]["lower95"]
    assert rows["m"]["unit"] == "kg"


def test_equations_for_a_modeller(run, capsys):
    assert main(["export", str(run), "--modelica", "--text"]) == ExitCode.DONE
    said = " ".join(capsys.readouterr().out.split())
    assert 'parameter Real harder_k(unit="' in said
    assert '"95 %: ' in said
    assert "harder_at_v = -harder_k*x^3;" in said
    assert "// add harder_at_v to the right side of der(v)" in said
    assert "harder (cubic) at der(v) der(v) += -k * x^3" in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "must be told what to write; add --fmu"),
        (["--fmu", "no/such/a.fmu"], "--fmu: must be in a folder that exists but no/such does not"),
        (["--ssv", "no/a.ssv"], "--ssv: must be in a folder that exists but no does not; make it"),
        (
            ["--fmu", "a.fmu", "--platforms", "mac"],
            "--platforms: must be of linux64, win64, darwin64",
        ),
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
