from collections.abc import Callable
from itertools import product

import pytest
from support.observed_executor import observe
from support.problems.springs import spring_problem
from support.run_folders import SPRING, rows, tables
from support.thinning import thinned

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.methods.method import Progress
from cluster_est.run_folder.run_folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.resources import SearchIteration

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


def test_the_table_of_searches_does_not_depend_on_which_was_quicker(tmp_path):
    """Also where searches share a name, as the refits of a design do."""
    result = ce.fit(spring_problem(experiments=2, noise=0.01).problem)
    lines = [
        SearchIteration("refits", Progress(1, 7.0), 6),
        SearchIteration("refits", Progress(1, 6.0, ending="converged"), 6),
        SearchIteration("refits", Progress(1, 8.0), 9),
        SearchIteration("refits", Progress(2, 5.0), 9),
        SearchIteration("models", Progress(0, 9.0), 1),
    ]
    found = set()
    for number, order in enumerate([lines, lines[::-1], lines[2:] + lines[:2]]):
        path = tmp_path / str(number)
        folder = RunFolder(path, RunIdentity(RunKind.FIT, result.problem, "", "hash", 0))
        for line in order:
            folder.note(line)
        folder.write(result)
        found.add(repr(rows(path, "searches")))
    assert len(found) == 1
