"""Designs that narrow predictions, against formulas of linear models."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.optimize import approx_fprime
from scipy.signal import lsim
from support.designs import design_of, designed, limits_text, read_text
from support.run_folders import SPRING, facts, rows, tables

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ClusterEstError, ProblemError
from cluster_est.experiment_design.request import DesignSettings
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.toml import to_toml

TIMES = 0.02 * np.arange(251)
FORCE = 0.8 + 0.3 * np.sin(0.9 * TIMES)
WIDE = limits_text(
    tail="[signals.y]\nlower = -9.0\nupper = 9.0", name="u", within=(-3.0, 3.0), duration=4.0
)
PLANNED = 3.0 * np.cos(1.3 * TIMES)
NOISE = 0.01


@pytest.fixture(scope="module")
def linear(tmp_path_factory, own_fmu):
    """A fit whose outputs are linear in what is estimated: y = FMU + b.k + u (1 + ...) f.k."""
    folder = tmp_path_factory.mktemp("linear")
    model = {"fmu": str(own_fmu("spring_table", 2))}
    blocks = [
        {"name": "b", "site": "output y", "form": "bias"},
        {"name": "f", "site": "output y", "form": "feed_through", "variables": ["u"]},
    ]
    run = {
        "id": "run",
        "data": str(folder / "run.csv"),
        "time": "time",
        "inputs": {"u": "F"},
        "outputs": {"y": "x"},
        "sigma": {"y": NOISE},
    }
    nothing = {"time": TIMES, "F": FORCE, "x": np.zeros(len(TIMES))}
    pacsv.write_csv(pa.table(nothing), folder / "run.csv")
    tree = {"model": model, "parameters": {"f5": {"start": 0.0, "fixed": True}}}
    tree |= {"effects": blocks, "experiments": [run]}
    (folder / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    (found, *_) = ce.simulate(ce.read_problem(folder / "config.toml")).values()
    simulated = found.outcome.trajectory
    noise = NOISE * np.random.default_rng(3).standard_normal(len(TIMES))
    measured = simulated.at("y", TIMES) + 0.2 + 0.05 * FORCE + noise
    pacsv.write_csv(pa.table(nothing | {"x": measured}), folder / "run.csv")
    result = ce.fit(ce.read_problem(folder / "config.toml"))
    rest = measured - simulated.at("y", TIMES)
    return result, rest


def wide(result, candidates, *targets):
    """The design that narrows predictions of the linear model."""
    settings = DesignSettings(predictions=targets, candidates=candidates)
    return ce.design(result, read_text(WIDE).limits, settings=settings)


def planned(values=PLANNED, name="planned"):
    return ce.Experiment(name, 0.0, float(TIMES[-1]), (ce.Input("u", TIMES, values),), ())


def rows_of(u):
    """(samples, 2): what bias and gain do to the output."""
    return np.column_stack([np.ones(len(u)), u])


def deviation(u, covariance):
    """The standard deviation of the output with this input, root mean square."""
    return np.sqrt(np.mean(np.einsum("ni,ij,nj->n", rows_of(u), covariance, rows_of(u))))


def test_the_standard_deviations_are_those_of_a_linear_model(linear):
    """With C = s^2 (X'X)^-1 of the samples that there are and of those that will be."""
    result, rest = linear
    old = rows_of(FORCE)
    coefficients, squares, *_ = np.linalg.lstsq(old, rest)
    variance = float(squares[0]) / (len(rest) - 2)
    assert {e.label: e.value for e in result.estimates if e.estimated_on == "train"} == (
        pytest.approx({"b.k": coefficients[0], "f.k": coefficients[1]}, abs=1e-5)
    )
    found = wide(result, 16, PredictionTarget(planned(), ("y",)), PredictionTarget("run"))
    assert found.criterion[0] == "v"
    before = variance * np.linalg.inv(old.T @ old)

    def after(candidate):
        new = rows_of(candidate.experiment.inputs[0].values)
        return variance * np.linalg.inv(old.T @ old + new.T @ new)

    def expected(covariance):
        return [deviation(PLANNED, covariance), deviation(FORCE, covariance)]

    assert [(p.experiment, p.output, p.unit) for p in found.predictions] == [
        ("planned", "y", ""), ("run", "y", ""),
    ]  # fmt: skip
    assert [p.std_error_before for p in found.predictions] == pytest.approx(
        expected(before), rel=0.01
    )
    assert [p.std_error_after for p in found.predictions] == pytest.approx(
        expected(after(found.chosen.candidate)), rel=0.01
    )
    then = np.array(expected(before))
    scores = [
        (-0.5 * np.log(np.mean((np.array(expected(after(each.candidate))) / then) ** 2)), each)
        for each in found.candidates
        if each.ok
    ]
    assert [each.value for _, each in scores] == pytest.approx([s for s, _ in scores], abs=0.01)
    assert found.chosen.value == max(each.value for _, each in scores)
    drawn = sorted(value for value, each in scores if each.candidate.origin == "random")
    middle = np.sqrt(np.mean([(p.random / p.std_error_before) ** 2 for p in found.predictions]))
    assert min(abs(middle - np.exp(-np.array(drawn)))) < 0.01
    assert "with a random input within the same limits, to " in found.summary


PREDICT = "[[predictions]]\n"
LIMITS = limits_text(duration=5.0, candidates=10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A fit, and a design of what makes the test experiment certain."""
    found = tmp_path_factory.mktemp("designs")
    assert main(["fit", SPRING, "--out", str(found / "fit"), "--no-report"]) == 0
    assert designed(found / "fit", found / "next.csv", LIMITS, "--predict", "exp4:y") == 0
    return found


@pytest.fixture
def design(folder, tmp_path):
    """Design after that fit once more, as `tmp_path / "new.csv"`."""

    def make(*arguments, text=LIMITS):
        return designed(folder / "fit", tmp_path / "new.csv", text, *arguments, "--no-report")

    return make


@pytest.fixture(scope="module")
def spring():
    return ce.fit(ce.read_problem(SPRING))


def test_the_command_says_what_becomes_certain(folder, capsys):
    assert main(["show", str(folder / "next")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert facts(folder / "next")["design"]["criterion"] == "v"
    assert "the standard deviation of y in exp4 is expected to fall to" in printed
    assert "predicted of unit std deviation now after it after a random input" in printed
    page = (folder / "next" / "report.html").read_text(encoding="utf-8")
    assert "Expected uncertainty of the predictions" in page
    (row,) = rows(folder / "next", "prediction_precision")
    assert (row["experiment"], row["output"]) == ("exp4", "y")
    assert row["std_error_after"] < row["random"] < row["std_error_before"]


def swung(values, experiment):
    """The displacement of the mass on its spring, of a linear system with straight input."""
    m, k, c = values
    system = ([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    times = 0.02 * np.arange(round(experiment.stop / 0.02) + 1)
    force = np.interp(times, experiment.inputs[0].times, experiment.inputs[0].values)
    return lsim(system, force, times, [dict(experiment.values).get("x", 0.0), 0.0])[1]


def test_the_standard_deviations_are_those_of_a_model_of_the_spring_in_scipy(spring):
    """Linear in m, k and c near their estimates; the new experiment as the old ones are."""
    text = limits_text(tail=PREDICT + 'experiment = "exp4"', duration=5.0, sample_time=0.02)
    found = design_of(spring, text)
    (row,) = (each for each in found.predictions if each.output == "y")
    values = np.array([spring.x[name] for name in ("m", "k", "c")])
    runs = {each.id: each for each in spring.problem.experiments}

    def slopes(*experiments):
        parts = [approx_fprime(values, swung, 1e-6, each) for each in experiments]
        return np.concatenate(parts)

    old = slopes(*(each for each in runs.values() if each.role == "train"))
    new, seen = slopes(found.experiment), slopes(runs["exp4"])
    noise = np.sqrt(np.sum(spring.fun**2) / (len(spring.fun) - 3))
    for information, expected in (
        (old.T @ old, row.std_error_before),
        (old.T @ old + new.T @ new, row.std_error_after),
    ):
        variances = np.einsum("ni,ij,nj->n", seen, np.linalg.inv(information), seen)
        assert noise * np.sqrt(variances.mean()) == pytest.approx(expected, rel=0.1)


def test_the_file_of_limits_says_the_same_as_the_command(folder, design, tmp_path):
    assert design(text=LIMITS + PREDICT + 'experiment = "exp4"\noutputs = ["y"]\n') == 0
    assert tables(tmp_path / "new") == tables(folder / "next")


def test_all_experiments_are_predicted_unless_some_are_named(design, tmp_path):
    assert design(text='criterion = "v"\n' + LIMITS) == 0
    found = rows(tmp_path / "new", "prediction_precision")
    assert [row["experiment"] for row in found] == [f"exp{i}" for i in range(1, 6)]


def test_a_planned_experiment_is_read_from_a_table(folder, spring, tmp_path):
    """The recorded force of an experiment as a plan: what is said of it is that of the recorded."""
    (force,) = spring.problem.experiments[3].inputs
    table = pa.table({"t": force.times, "force": force.values})
    pacsv.write_csv(table, tmp_path / "plan.csv")
    block = f'data = "{tmp_path}/plan.csv"\ntime = "t"\ninputs = {{ F = "force" }}\n'
    (row,) = design_of(spring, LIMITS + PREDICT + block).predictions
    (own,) = rows(folder / "next", "prediction_precision")
    assert (row.experiment, row.output) == ("plan", "y")
    assert row.std_error_before == pytest.approx(own["std_error_before"], rel=0.05)


FROM_TABLE = 'data = "{folder}/wrong.csv"'


@pytest.mark.parametrize(
    ("block", "table", "sentence"),
    [
        ('experiment = "exp7"', "", "experiment must be an experiment of the run, but is 'exp7'"),
        ('outputs = ["F"]', "", "outputs must be variables that the FMU computes, but 'F' is not"),
        ('data = "no.csv"', "", r"predictions\[0\]\.data"),
        (
            'data = "a.csv"\nexperiment = "exp4"',
            "",
            r"predictions\[0\]\.data: must not be used with",
        ),
        ('time = "t"', "", r"predictions\[0\]\.time: is only for a planned experiment"),
        ("outputs = 3", "", r"predictions\[0\]\.outputs"),
        (FROM_TABLE, "t,force\n0,1\n1,2\n", r"predictions\[0\]\.time"),
        (FROM_TABLE, "time,G\n0,1\n1,2\n", "has no variable 'G'"),
        (
            FROM_TABLE,
            "time,F\n0,1\n",
            "must have at least one column for an input and at least two rows",
        ),
        (
            FROM_TABLE,
            "time\n0\n1\n",
            "must have at least one column for an input and at least two rows",
        ),
        (FROM_TABLE, "time,F\n0,1\n0,2\n", "times must increase, but 0 repeats 0"),
        (FROM_TABLE, "time,F\n0,1\n1,high\n", r"predictions\[0\]\.inputs\.F"),
        (FROM_TABLE, "time,F\n0,1\n1,\n2,3\n", r"'F'\.values, index 1: must be a finite .* is nan"),
    ],
)
def test_what_cannot_be_predicted_is_refused_in_a_sentence(
    spring, tmp_path, block, table, sentence
):
    (tmp_path / "wrong.csv").write_text(table, encoding="utf-8")
    with pytest.raises(ClusterEstError, match=sentence):
        design_of(spring, LIMITS + PREDICT + block.format(folder=tmp_path))


def test_the_command_refuses_in_a_sentence_too(design, tmp_path, capsys):
    assert design("--predict", "exp9") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "predictions: experiment must be an experiment of the run, but is 'exp9'" in said
    assert not (tmp_path / "new.csv").exists()


def test_another_criterion_has_nothing_to_predict(design, capsys):
    assert design("--predict", "exp4", text='criterion = "d"\n' + LIMITS) == 2
    assert '--predict: predictions: must be used with the criterion "v"' in capsys.readouterr().err
    with pytest.raises(ClusterEstError, match=r"predictions: must be used with .*criterion is 'a'"):
        read_text('criterion = "a"\n' + LIMITS + PREDICT)
    with pytest.raises(ProblemError, match="experiment must be the name of an experiment"):
        PredictionTarget(3)


def test_what_depends_on_nothing_estimated_is_refused(linear):
    with pytest.raises(ProblemError, match="must depend on estimates of the run"):
        wide(linear[0], 10, PredictionTarget("run", ("x",)))


@pytest.mark.parametrize(
    ("plans", "name"),
    [([planned(name="run")], "run"), ([planned(PLANNED), planned(0.5 * PLANNED)], "planned")],
)
def test_an_experiment_of_its_own_needs_a_name_of_its_own(linear, plans, name):
    with pytest.raises(
        ProblemError, match=f"must have a unique name, but '{name}' is the name of another"
    ):
        wide(linear[0], 10, *map(PredictionTarget, plans))
