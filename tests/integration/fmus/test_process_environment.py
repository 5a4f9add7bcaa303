"""What an FMU finds around it: environment variables, and a working folder.

The truth is the solution of x' = -k x, x(0) = 1, by hand, times the gain: 2.5 exp(-k t).
"""

import os
import re
import subprocess
import sys
import zipfile
from dataclasses import replace
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from fmus.variables import read_model as read_spec
from support.decay_fits import RATE, estimate, fit_decay
from support.problems.springs import ROOT

from cluster_est import read_model
from workers.errors import ModelError

GAIN = 2.5
NAME = "GAIN_OF_THE_DECAY"
BOTH = pytest.mark.parametrize("fmi", [2, 3])


@pytest.fixture
def fitted(tmp_path, monkeypatch):
    """Fits k of an FMU to the truth, without the variable in this process; the run is in `run`."""
    monkeypatch.setenv(NAME, "")  # so that what a test leaves is taken away
    monkeypatch.delenv(NAME)

    def fit(fmu: Path, model: str, *overrides: str, gain: float = GAIN) -> int:
        return fit_decay(tmp_path, fmu, "--overwrite", *overrides, model=model, gain=gain)

    return fit


@pytest.fixture
def with_file(own_fmu, tmp_path):
    """An FMU that opens `gain.txt`, with that file among its resources."""

    def add(fmi: int) -> Path:
        path = tmp_path / f"with_file_fmi{fmi}.fmu"
        path.write_bytes(own_fmu("reads_file", fmi).read_bytes())
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("resources/tables/gain.txt", f"{GAIN}\n")
        return path

    return add


@pytest.mark.parametrize(
    ("executor", "fmi"),
    [
        *(("local", 2), ("processes", 3)),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in
          (("local", 3), ("processes", 2), ("ray", 2))),
    ],
)  # fmt: skip
def test_an_environment_variable_is_there_when_the_library_is_loaded(
    own_fmu, fitted, tmp_path, executor, fmi
):
    fmu, name = own_fmu("reads_environment", fmi), f"executor.name={executor}"
    if executor != "ray":  # which takes long to begin
        fitted(fmu, "", name)
        assert estimate(tmp_path) != pytest.approx(RATE, rel=1e-2), "the gain must matter"
    assert fitted(fmu, f'environment = {{ {NAME} = "{GAIN}" }}', name, "executor.workers=2") == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)
    assert (NAME in os.environ) is (executor == "local"), "a process of its own keeps it to itself"


def test_one_that_is_something_else_in_this_process_is_refused_there_alone(
    own_fmu, fitted, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv(NAME, "7.0")
    fmu, given = own_fmu("reads_environment", 2), f'environment = {{ {NAME} = "{GAIN}" }}'
    assert fitted(fmu, given) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(
        rf"environment.{NAME}: must be '2.5', but is already '7.0' in this process", said
    )
    assert 'choose executor.name = "processes" or "ray", or unset' in said
    assert os.environ[NAME] == "7.0"

    assert fitted(fmu, given, "executor.name=processes") == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)
    monkeypatch.setenv(NAME, str(GAIN))
    assert fitted(fmu, given) == 0


@pytest.mark.slow
def test_one_that_is_read_when_a_process_starts(own_fmu, fitted, tmp_path, capsys):
    """A library that the FMU needs, in a folder that is not known when this process starts."""
    fmu, folder = own_fmu("needs_library", 2), tmp_path / "libraries"
    folder.mkdir()
    absent = f"lib{read_spec('needs_library', 2).spec['needs_library']}.so"
    subprocess.run(["cc", "-shared", "-o", absent, "-x", "c", "/dev/null"], cwd=folder, check=True)
    assert fitted(fmu, "", "executor.name=processes") == 2
    assert "it needs the shared library" in " ".join(capsys.readouterr().err.split())
    given = f'environment = {{ LD_LIBRARY_PATH = "{folder}" }}'
    assert fitted(fmu, given, "executor.name=processes") in (0, 1)
    assert fitted(fmu, given) == 2
    assert "must be set before a process starts, but" in capsys.readouterr().err


@BOTH
def test_a_file_among_the_resources_is_opened_by_a_relative_path(fitted, with_file, tmp_path, fmi):
    here = os.getcwd()
    folder = 'working_folder = "resources/tables"'
    assert fitted(with_file(fmi), folder, "executor.name=processes", "executor.workers=2") == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)
    assert os.getcwd() == here


@pytest.mark.parametrize(
    ("folder", "executor", "said"),
    [
        ("resources/tables", "local", "needs workers in separate processes"),
        ("tables", "processes", "must be a folder in with_file_fmi2.fmu"),
        ("../outside", "processes", "must be a folder in the FMU"),
        ("/tmp", "processes", "must be a folder in the FMU"),
        ("C:\\\\data", "processes", "must be a folder in the FMU"),
    ],
)
def test_a_folder_that_cannot_be_is_refused(fitted, with_file, capsys, folder, executor, said):
    code = fitted(with_file(2), f'working_folder = "{folder}"', f"executor.name={executor}")
    assert code == 2
    assert f"model.working_folder: {said}" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"A=B": "1"}, r"names must not contain '='"),
        ({"": "1"}, r"names must not contain '='"),
        ({"A": "1\0"}, r"may contain a NUL character"),
        ({"A": 1}, r"model\.environment\.A: must be text, but is 1"),
        (["A"], r"must contain pairs"),
    ],
)
def test_variables_that_no_system_takes_are_refused(own_fmu, environment, said):
    with pytest.raises(ModelError, match=said):
        read_model(own_fmu("dahlquist", 2), environment=environment)  # type: ignore[arg-type]


def test_nothing_is_set_where_one_of_several_is_refused(own_fmu, fitted, monkeypatch):
    monkeypatch.setenv("SECOND", "b")
    given = f'environment = {{ {NAME} = "1", SECOND = "2" }}'
    assert fitted(own_fmu("dahlquist", 2), given) == 2
    assert NAME not in os.environ


def test_what_an_fmu_finds_is_part_of_what_its_simulations_depend_on(own_fmu):
    fmu = own_fmu("reads_environment", 2)
    models = [
        read_model(fmu),
        read_model(fmu, environment={NAME: "1"}),
        read_model(fmu, environment={NAME: "2"}),
        read_model(fmu, working_folder="resources"),
        read_model(fmu, stop_time=True),
        read_model(fmu, stop_time=False),
    ]
    assert len({model.key for model in models}) == len(models)
    assert replace(models[0], logging_on=True).key == models[0].key


@pytest.mark.parametrize(
    ("fmi", "solver", "executor"),
    [
        *((2, "dormand_prince", "local"), (3, "fmu", "processes")),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in
          ((2, "fmu", "local"), (2, "cvode", "processes"), (3, "rk4", "local"),
           (3, "dormand_prince", "processes"), (2, "fmu", "ray"))),
    ],
)  # fmt: skip
def test_an_fmu_that_needs_a_stop_time_is_told_it(own_fmu, fitted, tmp_path, fmi, solver, executor):
    interface = "co_simulation" if solver == "fmu" else "model_exchange"
    chosen = f'interface = "{interface}"\nsolver = "{solver}"\nstep = 0.002\n'
    if executor == "local":
        chosen += 'reset = "reset"\n'
    fmu = own_fmu("needs_stop_time", fmi)
    assert fitted(fmu, chosen, f"executor.name={executor}", gain=1.0) == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=3e-3)


def test_a_stop_time_can_be_withheld_and_given(own_fmu, fitted, tmp_path):
    fmu = own_fmu("needs_stop_time", 2)
    assert fitted(fmu, "stop_time = false", gain=1.0) == 1
    for model in ("stop_time = true", "stop_time = true\n[values]\nmultiple = 86400.0"):
        assert fitted(fmu, model, gain=1.0) == 0
        assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-4)


@pytest.mark.parametrize(
    ("command", "executor"),
    [
        ("fit", "processes"),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in
          (("check", "processes"), ("fit", "local"), ("check", "local"), ("fit", "ray"))),
    ],
)  # fmt: skip
def test_no_file_beside_a_config_is_executed(with_file, fitted, tmp_path, command, executor):
    """A file of each name that anything could import, and an FMU that reads one that is there."""
    folder, marker = tmp_path / "beside", tmp_path / "executed"
    folder.mkdir()
    fitted(with_file(2), "", "budget.evaluations=1")  # which leaves the config and the table
    names = {*sys.stdlib_module_names, *packages_distributions(), "workers", "cluster_est"}
    for name in names:
        said = f"open({str(marker)!r}, 'a').write({name + chr(10)!r})\n"
        (folder / f"{name}.py").write_text(said, encoding="utf-8")
    (folder / "gain.txt").write_text(f"{GAIN}\n", encoding="utf-8")
    asked = [str(tmp_path / "config.toml"), f"executor.name={executor}", "executor.workers=1"]
    more = ["--out", str(tmp_path / "run"), "--overwrite"] if command == "fit" else []
    ended = subprocess.run(
        [sys.executable, "-P", "-m", "cluster_est", command, *asked, *more],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert not marker.exists(), marker.read_text()
    if command == "fit":
        assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-4)
