import inspect
import json
import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.optimize
from support.problems.springs import FMU, ROOT, spring_problem

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ConfigError, ProblemError, RunFolderError
from cluster_est.problem.costs import COSTS
from cluster_est.problem.display import percent
from workers.fmu.description import describe

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
NAMES = """
    Budget CauchyCost ClusterEstError DesignSettings Effect Experiment ExperimentLimits HuberCost
    Input LeastSquares Limits LogNormalPrior LoopResult LoopSettings Model Multistart NormalPrior
    Output Parameter Problem Reading Resources Result SensitivitySettings Shooting SoftL1 Solver
    ThinningSettings UncertaintySettings add_effect analyse_sensitivity
    build_problem close_loop compare design detect export fit load locate read_config read_model
    read_problem read_table report residuals save simulate
"""


def test_the_exported_names_are_these():
    assert sorted(ce.__all__) == sorted(NAMES.split())
    assert dir(ce) == sorted(ce.__all__)
    assert all(getattr(ce, name) is not None for name in ce.__all__)
    with pytest.raises(AttributeError, match="no attribute 'colse_loop'"):
        _ = ce.colse_loop
    assert all(getattr(ce, name).__doc__ for name in ce.__all__)
    with pytest.raises(AttributeError, match="no attribute 'optimise'"):
        _ = ce.optimise


SETTINGS = [
    name for name in ce.__all__ if name.endswith(("Settings", "Limits"))
] + ["Multistart", "Shooting", "Resources", "Budget", "Reading"]  # fmt: skip


@pytest.mark.parametrize("name", SETTINGS)
def test_an_editor_completes_the_keys_of_settings(name):
    """As far as it reads the source alone, without running it."""
    jedi = pytest.importorskip("jedi")
    known = {each for each in inspect.signature(getattr(ce, name)).parameters if each != "values"}
    line = f"ce.{name}("
    found = jedi.Script(f"import cluster_est as ce\n{line}").complete(2, len(line))
    assert known
    assert {f"{key}=" for key in known} <= {each.name for each in found}


@pytest.fixture(scope="module")
def truth():
    return spring_problem(experiments=2, samples=80, noise=0.002)


@pytest.fixture(scope="module")
def result(truth):
    return ce.fit(truth.problem, seed=3)


def rows(folder, table):
    return pq.read_table(folder / f"{table}.parquet").to_pylist()


def check_tables(result, folder):
    """They are those of the run folder, but for what only a log can say."""
    written = {path.stem for path in folder.glob("*.parquet")}
    assert set(result.tables) == written - {"searches", "workers"}
    for name in result.tables:
        schema = pq.read_schema(folder / f"{name}.parquet")
        assert result.table(name).schema == schema, name
        assert repr(result.table(name).to_pylist()) == repr(rows(folder, name)), name  # NaN too


def test_a_result_has_the_fields_of_scipy(truth, result):
    assert result.success
    assert result.message == "converged"
    assert result.nit == result.solution.iterations
    assert result.nfev == result.evaluations > result.nit
    assert result.x["k"] == pytest.approx(truth.values["k"], rel=0.05)
    assert np.dot(result.fun, result.fun) == pytest.approx(result.cost)
    assert result.jac.shape == (160, 5)


def test_its_tables_are_arrow_tables(result):
    parameters = result.table("parameters")
    assert isinstance(parameters, pa.Table)
    assert parameters["label"].to_pylist() == ["m", "k", "c", "x0[e0]", "x0[e1]"]
    assert result.table("residuals").num_rows == 160
    assert result.table("trajectories").num_rows >= 160
    found = result.table("residuals")["residual"].to_numpy()
    assert np.dot(found, found) == pytest.approx(result.cost)
    with pytest.raises(RunFolderError, match="'residual'; did you mean 'residuals'"):
        result.table("residual")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A sensor that reads too much, as a result and as a run folder."""
    out = tmp_path_factory.mktemp("loop") / "run"
    changes = [f"experiments.{i}.columns.position.offset=0.1" for i in range(5)]
    changes += ["closed_loop.effects=['bias']", "closed_loop.max_effects=1"]
    assert main(["close-loop", str(CONFIG), *changes, "--out", str(out)]) == 0
    settings = ce.LoopSettings(forms=("bias",), max_effects=1)
    return ce.close_loop(ce.read_problem(CONFIG, changes), settings=settings), out


def test_the_result_of_a_loop_has_the_same_fields_and_tables(found):
    result, out = found
    assert [effect.form for effect in result.effects] == ["bias"]
    check_tables(result, out)
    assert list(result.params) == list(result.x)
    assert "value_before" in result.table("parameters").column_names
    assert result.success == result.after.success
    assert result.cost == pytest.approx(np.dot(result.fun, result.fun))
    assert result.nfev > result.nit > 0
    assert result.x == result.after.x
    assert result.jac.shape == (len(result.fun), len(result.after.solution.x))
    for shown in (html(result), str(result)):
        assert f"Search for missing effects: {result.verdict}." in shown
        assert percent(result.effects[0].claim.probability) in shown


def test_it_saves_and_reports_and_exports_itself(found, tmp_path):
    result, out = found
    saved = ce.save(result, tmp_path / "saved")
    check_tables(result, saved)
    mine, theirs = (json.loads((at / "run.json").read_text()) for at in (saved, out))
    for name in ("verdict", "effects", "errors", "notes", "cost", "status"):
        assert mine[name] == theirs[name], name
    loaded = ce.load(saved)
    assert loaded.summary() == result.summary()
    assert loaded.params == result.params
    assert (loaded.message, loaded.criteria) == (result.message, result.after.criteria)
    assert "bias" in ce.report(result, tmp_path / "loop.html").read_text(encoding="utf-8")
    assert "bias" in ce.export(result, text=True).printed[0]


def html(shown):
    return shown._repr_html_()


def test_a_problem_and_a_result_show_their_numbers(truth, result):
    assert FMU.name in html(truth.problem)
    assert f"{result.x['m']:.6g}" in html(result)
    for shown in (html(truth.problem), html(result)):
        assert "nan" not in shown
        assert not re.search(r"color|background", shown)  # light and dark notebooks alike
    lines = str(result).split("\n")
    assert lines[0].startswith("Fit: converged")
    head = lines.index("Parameters") + 1
    (row,) = (line for line in lines if line.startswith("m "))
    assert row[lines[head].index("value") :].split()[0] == f"{result.x['m']:.6g}"


def test_what_is_shown_is_escaped_and_long_tables_are_cut_and_say_so(truth):
    one = truth.problem.experiments[0]
    names = ["<script>x</script>", *(f"r{i}" for i in range(1, 60))]
    shown = html(replace(truth.problem, experiments=tuple(replace(one, id=n) for n in names)))
    assert "<script" not in shown
    assert "&lt;script&gt;" in shown
    assert "and 10 more" in shown
    assert "r49" in shown
    assert "r50" not in shown


def test_scipy_reaches_what_fit_reaches(truth, result):
    with ce.residuals(truth.problem) as f:
        found = scipy.optimize.least_squares(f, f.x0, jac=f.jac, bounds=f.bounds, xtol=1e-12)
        assert f.names == ("m", "k", "c", "x0[e0]", "x0[e1]")
        values = f.physical(found.x)
        assert f.x0[1] == pytest.approx(np.log(20.0))  # a logarithmic unknown
        assert f.bounds[1][1] == pytest.approx(np.log(200.0))
        assert f.physical(f.x0)["k"] == pytest.approx(20.0)
    assert 2.0 * found.cost == pytest.approx(result.cost, rel=1e-8)
    assert values == pytest.approx(result.x, rel=1e-4, abs=1e-6)


def test_the_derivatives_are_those_of_scipy(truth):
    with ce.residuals(truth.problem, differences="central") as f:
        x = f.x0 + 0.01
        expected = scipy.optimize.approx_fprime(x, f, 1e-6)
        assert f.jac(x) == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_residuals_at_a_point_that_fails_are_nan_and_say_why(truth):
    with ce.residuals(truth.problem) as f:
        x = f.x0
        x[0] = np.inf
        assert np.isnan(f(x)).all()
        assert f(x).shape == (160,)
        assert np.isnan(f.jac(x)).all()
        assert "parameter 'm' is inf" in f.reason
        assert np.isfinite(f(f.x0)).all()
        with pytest.raises(ProblemError, match=r"x must have 5 numbers .* shape \(2,\)"):
            f([1.0, 2.0])
    with pytest.raises(ProblemError, match="is closed; create it again"):
        f(f.x0)


def test_what_residuals_cannot_say_is_refused(truth):
    with pytest.raises(ProblemError, match=r"cost.name: must be .sse.*'huber'"):
        ce.residuals(replace(truth.problem, cost=COSTS["huber"]()))
    fixed = tuple(replace(p, fixed=True) for p in truth.problem.parameters)
    with pytest.raises(ProblemError, match="at least one must be free"):
        ce.residuals(replace(truth.problem, parameters=fixed))


def test_a_saved_run_is_that_of_the_command(tmp_path):
    by_command = tmp_path / "command"
    assert main(["fit", str(CONFIG), "--no-report", "--out", str(by_command)]) == 0
    found = ce.fit(ce.read_problem(CONFIG))
    check_tables(found, by_command)
    saved = ce.save(found, tmp_path / "run")
    check_tables(found, saved)
    mine, theirs = (json.loads((at / "run.json").read_text()) for at in (saved, by_command))
    assert mine.keys() == theirs.keys()
    own = {"checksum", "started", "seconds", "config_hash", "config_folder", "config_file"}
    for name in mine.keys() - own:
        different = name in ("reset_policy", "sensitivities")  # only a run says how it was chosen
        assert different or mine[name] == theirs[name], name
    assert list(found.notes) == mine["notes"]
    assert found.facts()["status"] == mine["status"] == "done"


def test_commands_read_what_was_saved(result, tmp_path, capsys):
    saved = ce.save(result, str(tmp_path / "run"))
    assert json.loads((saved / "run.json").read_text())["seed"] == 3
    assert main(["show", str(saved)]) == 0
    assert f"{result.x['m']:.6g}" in capsys.readouterr().out
    assert main(["report", str(saved)]) == 0
    assert (saved / "report.html").stat().st_size > 10_000
    assert main(["export", str(saved), "--text"]) == 2
    assert "was saved from Python without one" in capsys.readouterr().err


def test_nothing_is_replaced_unless_asked(result, tmp_path):
    saved = ce.save(result, tmp_path / "run")
    with pytest.raises(RunFolderError, match="holds a run already"):
        ce.save(result, saved)
    assert ce.save(result, saved, overwrite=True) == saved
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    with pytest.raises(
        RunFolderError, match="must be a new or empty folder, but holds other files"
    ):
        ce.save(result, tmp_path / "other", overwrite=True)
    with pytest.raises(ProblemError, match="folder: must be a path, but is 3"):
        ce.save(result, 3)


def test_a_report_is_one_file(result, tmp_path):
    path = ce.report(result, tmp_path / "springs.html")
    assert [each.name for each in tmp_path.iterdir()] == ["springs.html"]
    assert "springs" in path.read_text(encoding="utf-8")
    with pytest.raises(RunFolderError, match="cannot be written"):
        ce.report(result, tmp_path / "none" / "springs.html")


def test_an_export_has_the_estimates(result, tmp_path):
    found = ce.export(result, tmp_path / "fitted.fmu", modelica=False, text=True, experiment="e1")
    assert found.files == (tmp_path / "fitted.fmu",)
    assert f"{result.x['m']:.5g}" in found.printed[0]
    exported = describe("fitted.fmu", (tmp_path / "fitted.fmu").read_bytes())
    assert exported.variables["m"].start == pytest.approx(result.x["m"])
    assert exported.variables["x"].start == pytest.approx(result.x["x0[e1]"])


@pytest.mark.parametrize(
    ("given", "kind", "said"),
    [
        ({}, ConfigError, "needs an output to write"),
        ({"fmu": "fitted.txt"}, ConfigError, "must end in .fmu, but is 'fitted.txt'"),
        ({"text": True, "experiment": "e9"}, RunFolderError, "must be an experiment of the run"),
        ({"fmu": 3}, ProblemError, "fmu: must be a path, but is 3"),
    ],
)
def test_an_export_that_cannot_be(result, given, kind, said):
    with pytest.raises(kind, match=said):
        ce.export(result, **given)
