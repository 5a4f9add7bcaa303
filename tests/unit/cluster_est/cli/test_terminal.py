"""What is said beside the output of a command."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.problems.springs import spring_problem

from cluster_est import Effect, Parameter
from cluster_est.cli import terminal
from workers.kernels.fmi import compiling


@pytest.mark.parametrize("before", [True, False])
def test_compiling_is_announced_only_where_there_is_something_to_compile(
    before: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "compiled_before", lambda: before)
    terminal.say_if_compiled_first()
    said = " ".join(capsys.readouterr().err.split())
    assert ("are compiled for this machine first" in said) is not before


@pytest.mark.parametrize(("noisy", "before"), [(True, False), (True, True), (False, False)])
def test_the_filter_of_process_noise_is_said_to_be_compiled(noisy, before, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(terminal, "compiled_before", lambda module: asked.append(module) or before)
    problem = spring_problem(1, 20).problem
    if noisy:
        effect = Effect("n", "der(v)", "diffusion")
        parameters = (*problem.parameters, Parameter("n.q", 0.1))
        problem = replace(problem, effects=(effect,), parameters=parameters)
    terminal.say_if_filter_compiled_first(problem)
    assert ("its filter is compiled" in capsys.readouterr().err) is (noisy and not before)
    assert asked == (["kalman"] if noisy else [])


def test_loops_that_were_compiled_are_known_by_their_module(monkeypatch, tmp_path):
    monkeypatch.setattr(compiling, "_CACHE_FOLDER", str(tmp_path / "kernels"))
    assert not compiling.compiled_before()
    kept = tmp_path / "kernels" / "kernels_0"
    kept.mkdir(parents=True)
    (kept / "rk4.rk4_batch-1.nbi").touch()
    assert compiling.compiled_before()
    assert compiling.compiled_before("rk4")
    assert not compiling.compiled_before("kalman")
