from collections.abc import Callable
from itertools import product

import pytest
from support.observed_executor import observe
from support.run_folders import SPRING, tables
from support.thinning import thinned

from cluster_est.cli import main

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
    "fit": ["fit", SPRING],
    "sensitivity": ["sensitivity", SPRING],
    "posterior": ["fit", SPRING, SIGMA, "uncertainty.posterior=10", "uncertainty.walkers=8"],
    "design": ["design", "RUN", "--limits", "LIMITS"],
    "prior": ["fit", SPRING, SIGMA, 'parameters.m.prior={name="normal",mean=1.2,sd=0.1}'],
    "ordinal": ["fit", SPRING, KNOWN_MASS, *of_outputs("ordinal = true")],
    "own sensors": ["fit", SPRING, KNOWN_MASS, *of_outputs("free_scale = true")],
    "one sensor": ["fit", SPRING, KNOWN_MASS, *of_outputs('free_scale = "shared"')],
    "detection limit": ["fit", SPRING, SIGMA, *of_outputs("detection_limit = -0.1")],
}
"""The command of each kind of run, without what all of them take."""
DISTURBANCES = ("third answer", "budget", "eighth answer", "two processes")
LONG = {"ordinal", "posterior", "own sensors"}
CASES = thinned(
    [
        pytest.param(kind, how, marks=pytest.mark.slow if kind in LONG else ())
        for kind, how in product(KINDS, DISTURBANCES)
    ],
    lambda kind, _: kind,
    lambda _, how: how,
)

Run = Callable[..., tuple[int, dict[str, str]]]


@pytest.fixture(scope="module")
def run(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a kind into a folder of a name: the exit code, and its tables as text."""
    folder = tmp_path_factory.mktemp("kinds")
    places = {"RUN": str(folder / "known"), "LIMITS": str(folder / "limits.toml")}
    (folder / "limits.toml").write_text(LIMITS, encoding="utf-8")
    command = [places.get(word, word) for word in KINDS[kind]]
    if kind == "design":
        assert main(["fit", SPRING, SIGMA, "--out", places["RUN"], "--no-report"]) == 0

    def to(name: str, *more: str) -> tuple[int, dict[str, str]]:
        out = folder / f"{name}{'.csv' if kind == 'design' else ''}"
        code = main([*command, "--out", str(out), *more, "--no-report"])
        return code, tables(folder / name)

    return to


@pytest.fixture(scope="module")
def usual(run: Run) -> dict[str, str]:
    """The tables of the run that nothing disturbs."""
    code, found = run("usual")
    assert code == 0
    assert found
    return found


@pytest.mark.parametrize(("kind", "disturbance"), CASES, scope="module")
def test_whatever_disturbs_a_run_it_comes_to_the_same_bits(
    run, usual, disturbance, monkeypatch, capsys
):
    """By Ctrl-C while answers are waited for, by its budget, and by where it runs."""
    if disturbance == "two processes":
        assert run("two", "executor.name=processes", "executor.workers=2") == (0, usual)
        return
    if disturbance == "budget":
        code, found = run(disturbance, "budget.evaluations=6")
    else:
        observer = observe(monkeypatch)
        observer.disturb(3 if disturbance == "third answer" else 8, KeyboardInterrupt())
        code, found = run(disturbance)
    said = capsys.readouterr()
    assert code == (1 if disturbance == "budget" else 130)
    assert disturbance != "budget" or "budget" in said.out + said.err
    assert "Traceback" not in said.err
    assert found != usual
    assert run(disturbance, "--resume") == (0, usual)
