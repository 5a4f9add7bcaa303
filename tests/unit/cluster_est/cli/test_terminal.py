"""What is said beside the output of a command."""

from dataclasses import replace

import pytest
from support.problems.springs import spring_problem

from cluster_est import Effect, Parameter
from cluster_est.cli import terminal
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
