"""What holds for every kind of run: interrupts, budgets, executors and resuming change no bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.executors.local import LocalExecutor
from workers.messages import Outcome

CONFIG = str(ROOT / "configs" / "mass_spring_damper.toml")
CLOCKS = {"seconds", "busy_seconds", "started", "ended", "worker", "workers"}
KNOWN_MASS = "parameters.m.fixed=true"
SIGMA = "experiment_defaults.sigma.y=0.02"
LIMITS = """
criterion = "d"
duration = 10.0
sample_time = 0.05
candidates = 16
[inputs.F]
lower = -8.0
upper = 8.0
"""


def of_outputs(entry: str) -> list[str]:
    """Overrides that give the output of each experiment some keys."""
    table = f'{{ column = "position", {entry} }}'
    return [f"experiments.exp{i}.outputs.y={table}" for i in range(1, 6)]


KINDS: dict[str, list[str]] = {
    "fit": ["fit", CONFIG],
    "prior": ["fit", CONFIG, SIGMA, 'parameters.m.prior={name="normal",mean=1.2,sd=0.1}'],
    "posterior": ["fit", CONFIG, SIGMA, "uncertainty.posterior=10", "uncertainty.walkers=8"],
    "ordinal": ["fit", CONFIG, KNOWN_MASS, *of_outputs("ordinal = true")],
    "own sensors": ["fit", CONFIG, KNOWN_MASS, *of_outputs("free_scale = true")],
    "one sensor": ["fit", CONFIG, KNOWN_MASS, *of_outputs('free_scale = "shared"')],
    "detection limit": ["fit", CONFIG, SIGMA, *of_outputs("detection_limit = -0.1")],
    "sensitivity": ["sensitivity", CONFIG],
    "design": ["design", "RUN", "--limits", "LIMITS"],
}
"""The command of each kind of run, without what all of them take."""

Run = Callable[..., tuple[int, dict[str, str]]]


@pytest.fixture(scope="module", params=KINDS)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a kind into a folder of a name: the exit code, and its tables as text."""
    folder = tmp_path_factory.mktemp("kinds")
    places = {"RUN": str(folder / "known"), "LIMITS": str(folder / "limits.toml")}
    (folder / "limits.toml").write_text(LIMITS, encoding="utf-8")
    command = [places.get(word, word) for word in KINDS[request.param]]
    if request.param == "design":
        assert main(["fit", CONFIG, SIGMA, "--out", places["RUN"], "--no-report"]) == 0

    ending = ".csv" if request.param == "design" else ""

    def to(name: str, *more: str) -> tuple[int, dict[str, str]]:
        out = str(folder / f"{name}{ending}")
        code = main([*command, "--out", out, *more, "--no-report"])
        return code, tables(folder / name)

    return to


@pytest.fixture(scope="module")
def usual(run: Run) -> dict[str, str]:
    """The tables of the run that nothing disturbs."""
    code, found = run("usual")
    assert code == 0
    assert found
    return found


def tables(folder: Path) -> dict[str, str]:
    """Every table of results without clocks: NaN is not equal to itself, its text is."""
    found = {}
    for path in sorted(set(folder.glob("*.parquet")) - {folder / "workers.parquet"}):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if name not in CLOCKS]
        found[path.name] = repr(table.select(kept).to_pylist())
    return found


@pytest.mark.parametrize("after", [3, 8])
def test_an_interrupted_run_is_resumed_to_the_same_bits(
    run: Run,
    usual: dict[str, str],
    after: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As by Ctrl-C while simulations are waited for."""
    whole, calls = LocalExecutor.completed, 0

    def interrupted(executor: LocalExecutor) -> list[Outcome]:
        nonlocal calls
        calls += 1
        if calls == after:
            raise KeyboardInterrupt
        return whole(executor)

    with monkeypatch.context() as patch:
        patch.setattr(LocalExecutor, "completed", interrupted)
        code, _ = run(f"interrupted {after}")
    assert calls >= after
    assert code == 130
    assert "Traceback" not in capsys.readouterr().err
    assert run(f"interrupted {after}", "--resume") == (0, usual)


def test_a_budget_ends_it_and_without_one_it_goes_on_to_the_same_bits(
    run: Run, usual: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = run("short", "budget.evaluations=6")
    said = capsys.readouterr()
    assert code == 1
    assert "budget" in said.out + said.err
    assert "Traceback" not in said.err
    assert found != usual
    assert run("short", "--resume") == (0, usual)


def test_two_processes_give_the_same_bits(run: Run, usual: dict[str, str]) -> None:
    assert run("two", "executor.name=processes", "executor.workers=2") == (0, usual)
