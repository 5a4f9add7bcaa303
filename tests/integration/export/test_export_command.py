import csv
import re
import shutil
import struct
import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from fmpy import extract, read_model_description, simulate_fmu, supported_platforms
from fmpy.validation import validate_fmu
from lxml import etree
from support.exported import output_of
from support.run_folders import rows

from cluster_est import read_config, read_problem
from cluster_est.cli import main
from workers.core import build
from workers.fmu.platforms import PLATFORM

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
    assert main(["fit", str(base / "config.toml"), "--out", str(base / "run")]) == 0
    return base / "run"


@pytest.fixture
def export(run, capsys):
    """Export the run, and give what is printed and what is said beside it."""

    def call(*arguments, code=0):
        assert main(["export", str(run), *map(str, arguments)]) == code
        return [" ".join(text.split()) for text in capsys.readouterr()]

    return call


def values_of(run):
    return {row["label"]: row["value"] for row in rows(run, "parameters")}


def measured(run, experiment):
    path = run.parent / "data" / "mass_spring_damper" / f"{experiment}.csv"
    return np.genfromtxt(path, delimiter=",", names=True)


def test_the_exported_fmu_does_what_the_run_did(run, tmp_path, export):
    fmu = tmp_path / "repaired.fmu"
    export("--fmu", fmu, "--experiment", "exp5", "--no-step")
    assert validate_fmu(str(fmu)) == []
    found = values_of(run)
    starts = {v.name: v.start for v in read_model_description(str(fmu)).modelVariables}
    for name, label in [("m", "m"), ("x", "x0[exp5]"), ("harder.k", "harder.k")]:
        assert float(starts[name]) == found[label]
    data = measured(run, "exp5")
    truth = [r["simulated"] for r in rows(run, "trajectories") if r["experiment"] == "exp5"]
    folder = Path(extract(str(fmu), str(tmp_path / "unpacked")))
    result = output_of(folder, data["time"], {"F": data["force"]}, "y")
    np.testing.assert_allclose(result, truth, rtol=0.0, atol=1e-6)
    assert (
        "communication steps was not measured."
        in (folder / "documentation" / "README.md").read_text()
    )


@pytest.mark.slow
def test_the_fmu_says_which_step_reproduces_the_error_and_another_tool_finds_it(
    run, tmp_path, export
):
    fmu = tmp_path / "repaired.fmu"
    _, said = export("--fmu", fmu, "--experiment", "exp2")
    (named,) = re.findall(r"a communication step of (\S+) s reproduces the run's RMSE \(y: ", said)
    with zipfile.ZipFile(fmu) as archive:
        readme = archive.read("documentation/README.md").decode()
    assert f"a communication step of {named} s reproduces the run's RMSE" in readme
    assert "harder (cubic) at der(v)" in readme
    (shape,) = rows(run, "shapes")
    span = f"x from {min(shape['x']):.4g} to {max(shape['x']):.4g} m"
    assert f"estimated over {span}; extrapolated outside" in readme
    assert read_config(run / "config.toml").model.rtol is None  # what the solver then takes
    assert float(read_model_description(str(fmu)).defaultExperiment.tolerance) == 1e-8
    assert "The run had a relative tolerance of 1e-08" in " ".join(readme.split())
    errors = {row["experiment"]: row for row in rows(run, "errors")}
    for name, row in errors.items():
        sizes = f"{row['rmse_before']:.4g} | {row['rmse_after']:.4g}"
        assert f"| {name} | {'fitted' if row['role'] == 'train' else 'held out'} | y | m" in readme
        assert f"| {sizes} |" in readme
    step = float(read_model_description(str(fmu)).defaultExperiment.stepSize)
    assert step == pytest.approx(float(named), rel=1e-5)
    data = measured(run, "exp2")
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


def test_nothing_is_compiled(run, tmp_path, export, monkeypatch):
    """An export takes what is there, for the platforms of the original that have it."""
    monkeypatch.setattr(build, "BINARIES", tmp_path)
    build.library("wrapper", build.this_platform())
    monkeypatch.setattr(build, "build_into", None)
    monkeypatch.setattr(build.subprocess, "run", None)
    _, said = export("--fmu", tmp_path / "here.fmu", "--no-step")
    assert "does not run on darwin64 and win64, although the original does" in said
    fmpy_platforms = supported_platforms(str(tmp_path / "here.fmu"))
    assert fmpy_platforms == [PLATFORM]


def test_libraries_for_other_platforms(run, tmp_path, export, monkeypatch):
    """As a wheel carries them; a Mac's two parts become one library."""
    monkeypatch.setattr(build, "BINARIES", tmp_path)
    for platform in build.PLATFORMS:
        build.carried_path("wrapper", platform).write_bytes(f"for {platform}".encode())
    fmu = tmp_path / "everywhere.fmu"
    _, said = export("--fmu", fmu, "--no-step")
    assert "does not run on" not in said
    name = "binaries/{}/mass_spring_damper_repaired.{}"
    with zipfile.ZipFile(fmu) as archive:
        assert archive.read(name.format("linux64", "so")) == b"for x86_64-linux"
        assert archive.read(name.format("win64", "dll")) == b"for x86_64-windows"
        mac = archive.read(name.format("darwin64", "dylib"))
    assert struct.unpack(">II", mac[:8]) == (0xCAFEBABE, 2)
    for part, (wanted, of) in enumerate(((0x01000007, "x86_64"), (0x0100000C, "aarch64"))):
        processor, _, offset, size, _ = struct.unpack_from(">5I", mac, 8 + 20 * part)
        assert processor == wanted
        assert mac[offset : offset + size] == f"for {of}-darwin".encode()


def test_the_parameter_set_satisfies_the_schema_of_the_standard(tmp_path, export):
    path = tmp_path / "values.ssv"
    export("--ssv", path, "--experiment", "exp5")
    schema = files("fmpy.ssp") / "schema" / "SystemStructureParameterValues.xsd"
    tree = etree.parse(str(path))
    etree.XMLSchema(etree.parse(str(schema))).assertValid(tree)
    space = {"ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues"}
    units = {p.get("name"): p[0].get("unit") for p in tree.findall(".//ssv:Parameter", space)}
    assert (units["m"], units["x"]) == ("kg", "m")


@pytest.mark.parametrize("form", ["ssv", "csv"])
def test_the_values_of_a_run_are_the_starts_of_the_next(run, export, form):
    path, config = run.parent / f"found.{form}", run.parent / f"next_{form}.toml"
    export(f"--{form}", path, "--experiment", "exp5")
    text = (run.parent / "config.toml").read_text(encoding="utf-8")
    config.write_text(f'value_files = ["{path.name}"]\n{text}')
    starts = {p.name: p.start for p in read_problem(config).parameters}
    found = values_of(run)
    for name, label in [("m", "m"), ("x0", "x0[exp5]"), ("harder.k", "harder.k")]:
        assert starts[name] == found[label]


def test_a_table_of_values_has_their_intervals(run, tmp_path, export):
    path = tmp_path / "values.csv"
    export("--csv", path, "--experiment", "exp5")
    with path.open(newline="") as file:
        written = {row["name"]: row for row in csv.DictReader(file)}
    found = {row["label"]: row for row in rows(run, "parameters")}
    assert float(written["m"]["low"]) == found["m"]["lower95"]
    assert written["m"]["unit"] == "kg"


def test_equations_for_a_modeller(export):
    printed, said = export("--modelica", "--text")
    assert "x0 has a value for each experiment, so the exported FMU keeps" in said
    assert "(x0 = 0); to use the values of one experiment, give --experiment ID" in said
    assert 'parameter Real harder_k(unit="' in printed
    assert '"95 %: ' in printed
    assert "harder_at_v = -harder_k*x^3;" in printed
    assert "// add harder_at_v to the right side of der(v)" in printed
    assert "harder (cubic) at der(v) der(v) += -k * x^3" in printed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "needs an output to write.*--fmu"),
        (["--fmu", "no/such/a.fmu"], "--fmu: must be in an existing folder.*no/such"),
        (["--ssv", "no/a.ssv"], "--ssv: must be in an existing folder.*no does not"),
        (["--ssv", "values.xml"], r"must end in \.ssv.*'values\.xml'"),
        (["--text", "--experiment", "exp6"], "must be an experiment of the run.*'exp6'"),
        (["--text", "--config", "nowhere.toml"], "no config file nowhere.toml"),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(export, arguments, said):
    assert re.search(said, export(*arguments, code=2)[1])


def test_the_original_is_never_written_over(run, export):
    original = run.parent / "models" / "mass_spring_damper.fmu"
    before = original.read_bytes()
    assert "must differ from the original FMU" in export("--fmu", original, code=2)[1]
    assert original.read_bytes() == before


@pytest.fixture
def plain(run):
    """The config of the run without the effect."""
    config = run.parent / "plain.toml"
    text = (run.parent / "config.toml").read_text(encoding="utf-8")
    config.write_text(text.replace(EFFECT, ""), encoding="utf-8")
    return config


def test_values_of_a_run_with_an_effect_are_not_simulated_without_it(run, plain, tmp_path, capsys):
    out = tmp_path / "curves.csv"
    assert main(["simulate", str(plain), "--out", str(out), "--run", str(run)]) == 2
    said = capsys.readouterr().err
    assert re.search(r"harder\.k.*use the config of the run, .*config\.toml", said)
    assert not out.exists()
    of_run = str(run / "config.toml")  # its paths are relative to the original config
    assert main(["simulate", of_run, "--out", str(out), "--run", str(run)]) == 0
    assert read_problem(of_run).experiments == read_problem(run.parent / "config.toml").experiments


def test_effects_that_a_loop_found_are_added_to_the_config(
    run, plain, tmp_path, capsys, monkeypatch
):
    found = {"effects": [{"name": "harder", "config": EFFECT}]}
    monkeypatch.setattr("cluster_est.cli.run_commands.read_facts", lambda _: found)
    tables = []
    for config in (plain, run / "config.toml"):
        tables.append(tmp_path / f"{config.stem}.csv")
        arguments = ["simulate", str(config), "--out", str(tables[-1]), "--run", str(run)]
        assert main(arguments) == 0
        said = f"the effect harder of the run in {run} is added to the config"
        assert (said in capsys.readouterr().err) is (config == plain)
    assert tables[0].read_bytes() == tables[1].read_bytes()


def test_an_fmu_that_has_changed_is_refused(run, export):
    original = run.parent / "models" / "mass_spring_damper.fmu"
    before = original.read_bytes()
    original.write_bytes(before + b"\0")
    said = export("--text", code=2)[1]
    original.write_bytes(before)
    assert "must be the FMU of the run, but has changed" in said
