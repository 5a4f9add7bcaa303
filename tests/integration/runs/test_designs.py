import csv
import shutil
import tomllib
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.designs import design_of, designed, limits_text, read_text
from support.problems.springs import ROOT
from support.reported import Page
from support.run_folders import SPRING, change_facts, facts, rows, tables

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ProblemError
from cluster_est.toml import to_toml

CONFIG = ROOT / "configs" / "mass_with_friction.toml"
LIMITS = limits_text(tail="[signals.y]\nlower = -1.0\nupper = 1.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A closed loop, and the design of its next experiment with what was printed."""
    found = tmp_path_factory.mktemp("designs")
    loop = found / "loop"
    assert main(["close-loop", str(CONFIG), "--out", str(loop), "--no-report"]) == 0
    with (found / "printed.txt").open("w", encoding="utf-8") as file, redirect_stdout(file):
        assert designed(loop, found / "next.csv", LIMITS) == 0
    return found


@pytest.fixture
def design(folder, tmp_path) -> Callable[..., int]:
    """Design the next experiment after the loop once more, as `tmp_path / "new.csv"`."""

    def make(*arguments: str, text: str = LIMITS) -> int:
        return designed(folder / "loop", tmp_path / "new.csv", text, *arguments, "--no-report")

    return make


@pytest.fixture(scope="module")
def spring() -> ce.Result:
    return ce.fit(ce.read_problem(SPRING))


def table_of(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.reader(file))


def measured(table: Path, path: Path, value: Callable[[int], float]) -> None:
    """Fill the last column of a table, as one who measures does."""
    head, *lines = table_of(table)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([head, *([*row[:2], value(i)] for i, row in enumerate(lines))])


def test_it_says_what_the_experiment_will_tell_before_anybody_measures(folder, capsys):
    competing = facts(folder / "loop")["competing"]
    assert competing[0]["name"] == "coulomb at der(v)"
    assert len(competing) > 1
    assert sum(each["weight"] for each in competing) == pytest.approx(1.0)
    assert main(["show", str(folder / "next")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"next experiment: {facts(folder / 'next')['design']['summary']}" in printed
    assert "rival of coulomb at der(v)" in printed
    assert "assume that the models are exact" in printed
    page = (folder / "next" / "report.html").read_text(encoding="utf-8")
    for text in (
        "Input of the experiment",
        "Predicted outputs",
        "coulomb at der(v)",
        ">F (N)<",
        ">y (m)<",
    ):
        assert text in page
    probabilities = rows(folder / "next", "probabilities")
    told = sum(each["after"] > max(0.9, each["before"]) for each in probabilities)
    tells = f"{told} of {len(probabilities)} models from their" if told else "any model from its"
    assert f"expected to distinguish {tells} rivals" in page
    units = {each["label"]: each["unit"] for each in rows(folder / "next", "precision")}
    assert units["k"] == "N/m"


def test_the_chosen_input_is_worth_more_than_a_random_one(folder):
    (clear,) = (
        row
        for row in rows(folder / "next", "evidence")
        if (row["true_model"], row["rival"]) == ("stribeck at der(v)", "coulomb at der(v)")
    )
    assert clear["evidence"] > clear["random"]
    candidates = rows(folder / "next", "candidates")
    (chosen,) = (row for row in candidates if row["chosen"])
    assert chosen["value"] == max(r["value"] for r in candidates if np.isfinite(r["value"]))


def test_the_table_of_the_next_experiment_keeps_the_limits_and_is_read_by_init(folder, tmp_path):
    head, *lines = table_of(folder / "next.csv")
    assert head == ["time", "F", "y"]
    force = [float(row[1]) for row in lines]
    assert len(force) == 201
    assert -8.0 <= min(force) <= max(force) <= 8.0
    assert {row[2] for row in lines} == {""}
    measured(folder / "next.csv", tmp_path / "measured.csv", lambda i: 0.1 * (i + 1) % 1.0)
    fmu, out = CONFIG.parent / ce.read_config(CONFIG).model.fmu, tmp_path / "next.toml"
    assert main(["init", str(fmu), str(tmp_path / "measured.csv"), "--out", str(out)]) == 0
    (experiment,) = ce.read_config(out).experiments
    assert set(experiment.inputs) == {"F"}
    assert len(experiment.outputs) == 1


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["processes", "ray"])
def test_it_runs_where_the_config_of_the_loop_says_and_no_bit_changes(folder, tmp_path, executor):
    loop = Path(shutil.copytree(folder / "loop", tmp_path / "loop"))
    tree = tomllib.loads((loop / "config.toml").read_text(encoding="utf-8"))
    tree["executor"] |= {"name": executor, "workers": 2}
    (loop / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    assert designed(loop, tmp_path / "two.csv", LIMITS, "--no-report") == 0
    assert tables(tmp_path / "two") == tables(folder / "next")


def test_a_design_is_resumed_from_its_log(folder, design, tmp_path, capsys):
    cut = Path(shutil.copytree(folder / "next", tmp_path / "new"))
    (cut / "next_input.parquet").unlink()
    change_facts(cut, status="interrupted")
    assert design("--resume") == 0
    assert "its log has" in capsys.readouterr().err
    assert tables(cut) == tables(folder / "next")
    assert design("--resume") == 0
    assert "is already finished" in capsys.readouterr().err


def test_what_is_there_is_not_overwritten(folder, tmp_path, capsys):
    loop, full = folder / "loop", tmp_path / "measured.csv"
    full.write_text("time,F,y\n0.0,1.0,0.5\n", encoding="utf-8")
    for out, how, said in (
        (folder / "next.csv", [], "exists already"),
        (folder / "loop.csv", ["--overwrite"], "but this folder contains or is the run to read"),
        (full, ["--overwrite"], "contains measurements, which are not overwritten"),
        (full, ["--resume"], "contains measurements, which are not overwritten"),
    ):
        assert designed(loop, out, LIMITS, *how) == 2
        assert said in capsys.readouterr().err
    assert (loop / "effects.parquet").is_file()
    assert full.read_text(encoding="utf-8").endswith("0.5\n")


def test_the_block_that_is_printed_makes_it_one_more_experiment(folder):
    printed = (folder / "printed.txt").read_text(encoding="utf-8")
    block = printed[printed.index("[[experiments]]") :].replace("next.csv", "filled.csv")
    measured(folder / "next.csv", folder / "filled.csv", lambda _: 0.01)
    config = ROOT / "configs" / "with_next.toml"
    try:
        config.write_text(CONFIG.read_text(encoding="utf-8") + "\n" + block, "utf-8")
        (*_, last) = ce.read_problem(config).experiments
    finally:
        config.unlink()
    assert last.id == "next"
    assert [given.variable for given in last.inputs] == ["F"]
    assert last.outputs[0].values == pytest.approx(0.01)


def test_the_page_and_the_terminal_name_the_table_the_config_and_the_command(folder):
    printed = (folder / "printed.txt").read_text(encoding="utf-8")
    page = Page(folder / "next" / "report.html").text
    again = f"cluster-est close-loop {CONFIG.resolve()} --out {folder / 'next-loop'}"
    block = printed[printed.index("[[experiments]]") :]
    assert f"Run the experiment with the input in {folder / 'next.csv'}, write" in page
    for text in (printed, page):
        assert again in text
        assert f"add the experiment to {CONFIG.resolve()}, and" in text
    assert " ".join(block.split()) in page


@pytest.mark.slow
def test_overrides_say_where_it_runs_and_for_how_long(folder, design, tmp_path, capsys):
    assert design("parameters.k.start=3") == 2
    assert "must be a key of executor, budget, log" in capsys.readouterr().err
    assert design(f"budget.evaluations={int(0.6 * facts(folder / 'next')['evaluations'])}") == 0
    notes = facts(tmp_path / "new")["notes"]
    assert any("the budget was used up after" in note for note in notes)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("[inputs.F]", "[inputs.G]", "inputs.G: must be an input of experiment"),
        ("[signals.y]", "[signals.q]", "signals.q: must be a variable of the FMU"),
        ("duration", 'like = "exp9"\nduration', "like: must be an experiment of the run, but is"),
        ("duration", 'rivals = ["viscous"]\nduration', "rivals: must be among the possible models"),
        ("duration", 'parameters = ["K"]\nduration', "parameters: must be among the estimates of"),
        ("lower = -1.0\nupper = 1.0", "lower = 5.0\nupper = 6.0", "limits: signals.y.lower must"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_run_is_refused_in_a_sentence(
    design, tmp_path, capsys, old, new, sentence
):
    assert design(text=LIMITS.replace(old, new)) in (1, 2)
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "new.csv").exists()


@pytest.mark.slow
def test_an_input_that_moves_nothing_tells_nothing_apart(design, tmp_path):
    """The mass is at rest, and stays there with either friction."""
    assert design(text=limits_text(within=(-1e-6, 1e-6), candidates=10)) == 0
    assert "does not distinguish it from its rivals" in facts(tmp_path / "new")["design"]["summary"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (limits_text('criterion = "discriminate"'), "needs at least two models to distinguish"),
        (
            limits_text('waveforms = ["recorded"]', within=(50.0, 60.0), duration=[9.0, 9.0]),
            "waveforms: must leave an input to try",
        ),
    ],
)
def test_what_a_fit_cannot_be_designed_for_is_refused(spring, text, said):
    with pytest.raises(ProblemError, match=said):
        design_of(spring, text)


def test_no_result_is_refused():
    with pytest.raises(ProblemError, match="result: must be a result of fit or close_loop"):
        ce.design(3, read_text(LIMITS).limits)


def test_an_input_that_is_held_is_designed_so():
    problem = ce.read_problem(SPRING)
    runs = tuple(
        replace(e, inputs=tuple(replace(g, interpolation="hold") for g in e.inputs))
        for e in problem.experiments
    )
    result = ce.fit(replace(problem, experiments=runs))
    top = 'waveforms = ["recorded", "steps"]'
    found = design_of(result, limits_text(top, duration=9.98, candidates=10))
    assert {given.interpolation for given in found.experiment.inputs} == {"hold"}
    assert 'F = { column = "F", interpolation = "hold" }' in found.experiment_block("next.csv")


def test_standard_errors_begin_at_those_of_the_fit_where_noise_is_autocorrelated():
    problem = ce.read_problem(SPRING)
    generator, runs = np.random.default_rng(3), []
    for experiment in problem.experiments:
        (output,) = experiment.outputs
        wave = generator.standard_normal(len(output.times))
        for i in range(1, len(wave)):
            wave[i] = 0.9 * wave[i - 1] + np.sqrt(1.0 - 0.81) * wave[i]
        made = replace(output, values=output.values + 0.003 * wave, sigma=0.003)
        runs.append(replace(experiment, outputs=(made,)))
    result = ce.fit(replace(problem, experiments=tuple(runs)))
    found = design_of(result, limits_text(duration=9.0, sample_time=0.02, candidates=10))
    own = {each.label: each.std_error for each in result.estimates}
    for row in found.precision:
        assert row.std_error_before == pytest.approx(own[row.label], rel=0.5)
        assert row.std_error_after < row.std_error_before


def test_the_standard_errors_that_come_are_those_that_were_expected(spring):
    """Against a fit to the new experiment, simulated with noise that the design has not seen."""
    problem = spring.problem
    found = design_of(spring, limits_text(sample_time=0.02))
    assert found.criterion[0] == "d", "a fit has no rivals"
    assert [row.label for row in found.precision] == ["m", "k", "c"]
    experiment = found.experiment
    (truth,) = ce.simulate(
        ce.Problem(problem.model, problem.parameters, (experiment,)),
        values={name: spring.x[name] for name in ("m", "k", "c")},
    ).values()
    assert truth.outcome.ok
    (output,), generator = experiment.outputs, np.random.default_rng(4)
    noise = output.sigma * generator.standard_normal(len(output.times))
    values = truth.outcome.trajectory.at(output.variable, output.times) + noise
    sigma = problem.experiments[0].outputs[0].sigma
    measured = replace(
        experiment, id="next", outputs=(replace(output, values=values, sigma=sigma),)
    )
    both = ce.fit(replace(problem, experiments=(*problem.experiments, measured)))
    errors = {each.label: each.std_error for each in both.estimates}
    for row in found.precision:
        assert errors[row.label] == pytest.approx(row.std_error_after, rel=0.15)
        assert row.std_error_after < row.std_error_before
