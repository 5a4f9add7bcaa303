"""Runs of `cluster-est design`: what is printed and written, resumed and refused."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.config.limits_file import read_limits
from cluster_est.errors import ProblemError
from cluster_est.experiment_design.design import make_design
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits
from cluster_est.experiment_design.models import CandidateModel
from cluster_est.experiment_design.request import DesignRequest
from cluster_est.experiment_design.settings import DesignSettings
from cluster_est.running.environment import RunEnvironment
from cluster_est.toml import to_toml

CONFIG = str(ROOT / "configs" / "mass_with_friction.toml")
SPRING = str(ROOT / "configs" / "mass_spring_damper.toml")
TABLES = ("candidates", "probabilities", "evidence", "precision", "next_input", "expected")
LIMITS = """
duration = 10.0
sample_time = 0.05
candidates = 24
[inputs.F]
lower = -8.0
upper = 8.0
[signals.y]
lower = -1.0
upper = 1.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A closed loop, and the design of its next experiment."""
    found = tmp_path_factory.mktemp("designs")
    (found / "limits.toml").write_text(LIMITS, encoding="utf-8")
    assert main(["close-loop", CONFIG, "--out", str(found / "loop"), "--no-report"]) == 0
    assert designed(found, found / "next.csv") == 0
    return found


def designed(folder: Path, out: Path, *arguments: str, limits: str = "limits.toml") -> int:
    loop = str(folder / "loop")
    given = ["--limits", str(folder / limits), "--out", str(out), *arguments]
    return main(["design", loop, *given])


def rows(run: Path) -> dict[str, str]:
    """The tables as text: NaN is not equal to itself."""
    return {name: repr(pq.read_table(run / f"{name}.parquet").to_pylist()) for name in TABLES}


def test_a_loop_keeps_the_rivals_of_its_finding(folder):
    facts = json.loads((folder / "loop" / "run.json").read_text(encoding="utf-8"))
    names = [each["name"] for each in facts["competing"]]
    assert names[0] == "coulomb at der(v)"
    assert len(names) > 1
    assert sum(each["weight"] for each in facts["competing"]) == pytest.approx(1.0)


def test_it_says_what_the_experiment_will_tell_before_anybody_measures(folder, capsys):
    assert main(["show", str(folder / "next")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    facts = json.loads((folder / "next" / "run.json").read_text(encoding="utf-8"))
    assert f"next experiment: {facts['design']['summary']}" in printed
    assert "rival of coulomb at der(v)" in printed
    assert "rests on the models being exact" in printed


def test_the_chosen_input_is_worth_more_than_a_random_one(folder):
    rows = pq.read_table(folder / "next" / "evidence.parquet").to_pylist()
    (clear,) = (
        row
        for row in rows
        if (row["true_model"], row["rival"]) == ("stribeck at der(v)", "coulomb at der(v)")
    )
    assert clear["evidence"] > clear["random"]
    candidates = pq.read_table(folder / "next" / "candidates.parquet").to_pylist()
    (chosen,) = (row for row in candidates if row["chosen"])
    assert chosen["value"] == max(r["value"] for r in candidates if np.isfinite(r["value"]))


def test_the_table_of_the_next_experiment_keeps_the_limits(folder):
    with (folder / "next.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == ["time", "F", "y"]
    force = np.array([float(row["F"]) for row in table])
    assert len(force) == 201
    assert -8.0 <= force.min() <= force.max() <= 8.0
    assert {row["y"] for row in table} == {""}


def test_init_reads_the_table_once_it_has_been_measured(folder, tmp_path):
    with (folder / "next.csv").open(encoding="utf-8") as file:
        table = list(csv.reader(file))
    measured = tmp_path / "measured.csv"
    with measured.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(
            [table[0], *([*row[:2], 0.1 * i % 1.0] for i, row in enumerate(table[1:]))]
        )
    fmu = next((ROOT / "configs" / "models").glob("mass_*.fmu"))
    config = ROOT / "configs" / "mass_with_friction.toml"
    fmu = config.parent / ce.read_config(config).model.fmu
    out = tmp_path / "next.toml"
    assert main(["init", str(fmu), str(measured), "--out", str(out)]) == 0
    (experiment,) = ce.read_config(out).experiments
    assert set(experiment.inputs) == {"F"}
    assert len(experiment.outputs) == 1


def test_its_report_shows_the_input_and_what_is_expected(folder):
    page = (folder / "next" / "report.html").read_text(encoding="utf-8")
    for text in ("The next experiment", "What is fed in", "What is expected", "coulomb at der(v)"):
        assert text in page


@pytest.mark.parametrize(
    "executor", ["local", "processes", pytest.param("ray", marks=pytest.mark.slow)]
)
def test_where_it_runs_changes_no_bit(folder, tmp_path, executor):
    loop = tmp_path / "loop"
    loop.mkdir()
    for each in (folder / "loop").iterdir():
        if each.is_file():
            (loop / each.name).write_bytes(each.read_bytes())
    tree = tomllib.loads((loop / "config.toml").read_text(encoding="utf-8"))
    tree["executor"] |= {"name": executor, "workers": 2}
    (loop / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    given = ["--limits", str(folder / "limits.toml"), "--out", str(tmp_path / "two.csv")]
    assert main(["design", str(loop), *given, "--no-report"]) == 0
    assert rows(tmp_path / "two") == rows(folder / "next")


def test_a_design_is_resumed_from_its_log(folder, tmp_path, capsys):
    out = tmp_path / "cut.csv"
    assert designed(folder, out, "--no-report") == 0
    (tmp_path / "cut" / "next_input.parquet").unlink()
    facts = json.loads((tmp_path / "cut" / "run.json").read_text(encoding="utf-8"))
    facts["status"] = "interrupted"
    (tmp_path / "cut" / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    capsys.readouterr()
    assert designed(folder, out, "--resume", "--no-report") == 0
    assert "simulations stand in its log" in capsys.readouterr().err
    assert rows(tmp_path / "cut") == rows(folder / "next")
    assert designed(folder, out, "--resume", "--no-report") == 0
    assert "holds a finished run" in capsys.readouterr().err


def test_what_is_there_is_not_overwritten(folder, tmp_path, capsys):
    assert designed(folder, folder / "next.csv") == 2
    assert "is there already" in capsys.readouterr().err
    assert designed(folder, folder / "loop.csv", "--overwrite") == 2
    assert "which holds or is the run that is read" in capsys.readouterr().err
    assert (folder / "loop" / "effects.parquet").is_file()
    measured = tmp_path / "measured.csv"
    measured.write_text("time,F,y\n0.0,1.0,0.5\n", encoding="utf-8")
    for how in ("--overwrite", "--resume"):
        assert designed(folder, measured, how) == 2
        assert "holds measurements already, which are kept" in capsys.readouterr().err
    assert measured.read_text(encoding="utf-8").endswith("0.5\n")


def test_the_block_that_is_printed_makes_it_one_more_experiment(folder, tmp_path, capsys):
    out = tmp_path / "next.csv"
    assert designed(folder, out, "--no-report") == 0
    printed = capsys.readouterr().out
    block = printed[printed.index("[[experiments]]") :]
    with out.open(encoding="utf-8") as file:
        table = list(csv.reader(file))
    with out.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([table[0], *([*row[:2], 0.01] for row in table[1:])])
    config = ROOT / "configs" / "with_next.toml"
    try:
        config.write_text(Path(CONFIG).read_text(encoding="utf-8") + "\n" + block, "utf-8")
        (*_, last) = ce.read_problem(config).experiments
    finally:
        config.unlink()
    assert last.id == "next"
    assert [given.variable for given in last.inputs] == ["F"]
    assert last.outputs[0].values == pytest.approx(0.01)


def test_overrides_say_where_it_runs_and_for_how_long(folder, tmp_path, capsys):
    loop = str(folder / "loop")
    given = ["--limits", str(folder / "limits.toml"), "--out", str(tmp_path / "short.csv")]
    assert main(["design", loop, "parameters.k.start=3", *given]) == 2
    assert "must be a key of executor, budget, log" in capsys.readouterr().err
    whole = json.loads((folder / "next" / "run.json").read_text(encoding="utf-8"))["evaluations"]
    budget = f"budget.evaluations={int(0.8 * whole)}"
    assert main(["design", loop, budget, *given, "--no-report"]) == 0
    facts = json.loads((tmp_path / "short" / "run.json").read_text(encoding="utf-8"))
    assert any("the budget was used up after" in note for note in facts["notes"])


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("[inputs.F]", "[inputs.G]", "inputs.G: must be an input of experiment"),
        ("[signals.y]", "[signals.q]", "signals.q: must be a variable of the FMU"),
        ("duration", 'like = "exp9"\nduration', "like: must be an experiment of the run but is"),
        (
            "duration",
            'rivals = ["viscous"]\nduration',
            "rivals: must be of the models that the run",
        ),
        ("duration", 'parameters = ["K"]\nduration', "parameters: must be of what the run has"),
        (
            "lower = -1.0\nupper = 1.0",
            "lower = 5.0\nupper = 6.0",
            "limits: signals.y.lower must be",
        ),
    ],
)
def test_what_does_not_fit_the_run_is_refused_in_a_sentence(
    folder, tmp_path, capsys, old, new, sentence
):
    (folder / "other.toml").write_text(LIMITS.replace(old, new), encoding="utf-8")
    code = designed(folder, tmp_path / "never.csv", "--no-report", limits="other.toml")
    said = " ".join(capsys.readouterr().err.split())
    assert code in (1, 2)
    assert sentence in said
    assert not (tmp_path / "never.csv").exists()


def test_a_fit_has_no_rivals_and_its_parameters_are_narrowed(tmp_path):
    limits = tmp_path / "limits.toml"
    limits.write_text(LIMITS, encoding="utf-8")
    wanted = read_limits(limits)
    result = ce.fit(ce.read_problem(SPRING))
    found = ce.design(result, wanted.limits, settings=wanted.settings)
    assert found.criterion[0] == "d"
    assert [row.label for row in found.precision] == ["m", "k", "c"]
    assert all(row.std_error_after < row.std_error_before for row in found.precision)
    again = ce.design(result, wanted.limits, settings=wanted.settings)
    np.testing.assert_array_equal(
        again.experiment.inputs[0].values, found.experiment.inputs[0].values
    )
    with pytest.raises(ProblemError, match="must have at least two models to tell apart"):
        ce.design(result, wanted.limits, settings=DesignSettings(criterion="discriminate"))


def test_nothing_is_expected_to_tell_a_model_from_its_copy():
    result = ce.fit(ce.read_problem(SPRING))
    models = tuple(CandidateModel(name, result.problem, result.x, 0.5) for name in ("one", "other"))
    limits = ExperimentLimits({"F": InputLimits(-8.0, 8.0)}, (9.0, 9.0), 0.05)
    request = DesignRequest(models, limits, DesignSettings(candidates=10))
    found = make_design(RunEnvironment(), request)
    assert [row.evidence for row in found.evidence] == pytest.approx([0.0, 0.0], abs=0.05)
    assert [row.after for row in found.probabilities] == pytest.approx([0.5, 0.5], abs=0.01)
    assert "does not tell it from its rivals" in found.summary


def test_only_recorded_inputs_may_keep_no_limits():
    result = ce.fit(ce.read_problem(SPRING))
    limits = ExperimentLimits({"F": InputLimits(50.0, 60.0)}, (9.0, 9.0), 0.05)
    with pytest.raises(ProblemError, match="waveforms: must leave an input to look at"):
        ce.design(result, limits, settings=DesignSettings(waveforms=("recorded",)))


def test_no_result_is_refused():
    with pytest.raises(ProblemError, match="result: must be what fit or close_loop returned"):
        ce.design(3, ExperimentLimits({"F": InputLimits(-1.0, 1.0)}, 4.0, 0.05))


def test_an_input_that_is_held_is_designed_so():
    problem = ce.read_problem(SPRING)
    runs = tuple(
        replace(e, inputs=tuple(replace(g, interpolation="hold") for g in e.inputs))
        for e in problem.experiments
    )
    result = ce.fit(replace(problem, experiments=runs))
    limits = ExperimentLimits({"F": InputLimits(-8.0, 8.0)}, 9.98, 0.05)
    settings = DesignSettings(candidates=10, waveforms=("recorded", "steps"))
    found = ce.design(result, limits, settings=settings)
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
    limits = ExperimentLimits({"F": InputLimits(-8.0, 8.0)}, 9.0, 0.02)
    found = ce.design(result, limits, settings=DesignSettings(candidates=10))
    own = {each.label: each.std_error for each in result.estimates}
    for row in found.precision:
        assert row.std_error_before == pytest.approx(own[row.label], rel=0.5)
        assert row.std_error_after < row.std_error_before


def test_the_standard_errors_that_come_are_those_that_were_expected(tmp_path):
    """Against a fit to the new experiment, simulated with noise that the design has not seen."""
    problem = ce.read_problem(SPRING)
    result = ce.fit(problem)
    limits = ExperimentLimits({"F": InputLimits(-8.0, 8.0)}, 10.0, 0.02)
    found = ce.design(result, limits, settings=DesignSettings(criterion="d", candidates=24))
    experiment = found.experiment
    truth = ce.simulate(
        ce.Problem(problem.model, problem.parameters, (experiment,)),
        values={name: result.x[name] for name in ("m", "k", "c")},
    )
    assert truth[0].outcome.ok
    generator = np.random.default_rng(4)
    outputs = tuple(
        ce.Output(
            o.variable,
            o.times,
            truth[0].outcome.trajectory.at(o.variable, o.times)
            + o.sigma * generator.standard_normal(len(o.times)),
            problem.experiments[0].outputs[0].sigma,
        )
        for o in experiment.outputs
    )
    measured = ce.Experiment(
        "next", experiment.start, experiment.stop, experiment.inputs, outputs, experiment.values
    )
    both = ce.fit(ce.Problem(problem.model, problem.parameters, (*problem.experiments, measured)))
    errors = {each.label: each.std_error for each in both.estimates}
    for row in found.precision:
        assert errors[row.label] == pytest.approx(row.std_error_after, rel=0.15)
