"""What is said beside the output of a command, and what a command imports."""

import subprocess
import sys
import tomllib
from dataclasses import replace

import pytest
from support.problems.springs import ROOT, spring_problem

from cluster_est import Effect, Parameter
from cluster_est.cli import main, terminal
from workers.kernels.fmi import compiling


@pytest.fixture
def loops(tmp_path, monkeypatch):
    """Where compiled loops are kept: nowhere yet."""
    monkeypatch.setattr(compiling, "_CACHE_FOLDER", str(tmp_path / "kernels"))
    return tmp_path / "kernels" / "kernels_0"


def test_compiling_is_announced_only_where_there_is_something_to_compile(loops, capsys):
    for announced in (True, False):
        terminal.say_if_compiled_first()
        said = " ".join(capsys.readouterr().err.split())
        assert ("are compiled for this machine first" in said) is announced
        loops.mkdir(parents=True, exist_ok=True)


@pytest.mark.parametrize(
    ("noisy", "kept", "announced"),
    [(True, "rk4.rk4_batch", True), (True, "kalman.filter", False), (False, "rk4.rk4", False)],
)
def test_the_filter_of_process_noise_is_said_to_be_compiled(loops, capsys, noisy, kept, announced):
    loops.mkdir(parents=True)
    (loops / f"{kept}-1.nbi").touch()
    problem = spring_problem(1, 20).problem
    if noisy:
        effect = Effect("n", "der(v)", "diffusion")
        parameters = (*problem.parameters, Parameter("n.q", 0.1))
        problem = replace(problem, effects=(effect,), parameters=parameters)
    terminal.say_if_filter_compiled_first(problem)
    assert ("its filter is compiled" in capsys.readouterr().err) is announced


@pytest.mark.parametrize("installed", [True, False])
def test_the_version_is_that_of_the_project_where_it_is_installed(capsys, monkeypatch, installed):
    if not installed:
        monkeypatch.setattr(sys, "path", [])
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    printed = capsys.readouterr().out
    assert (printed == f"cluster-est {project['version']}\n") is installed
    assert ("not installed" in printed) is not installed


STARTED = """
import sys
from cluster_est.cli import main
main(["show", sys.argv[1]])
main(["check", sys.argv[2], "--seconds", "0"])
assert "pandas" not in sys.modules, "pandas was imported"
import pandas as pd
import pyarrow as pa
import cluster_est as ce
frame = pd.DataFrame({"t": [0.0, 1.0, 2.0], "y": [1.0, None, 3.0]})
run = ce.Experiment.from_table(frame, id="e", time="t", outputs=["y"])
assert run.outputs[0].values.tolist() == [1.0, 3.0]
assert pa.table({"a": [1]}).to_pandas().a.tolist() == [1]
print("as before")
"""


@pytest.mark.slow
def test_no_command_imports_pandas_and_python_users_lose_nothing(tmp_path):
    config = ROOT / "configs" / "mass_spring_damper.toml"
    done = subprocess.run(
        [sys.executable, "-c", STARTED, str(tmp_path), str(config)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1:] == ["as before"], done.stderr
