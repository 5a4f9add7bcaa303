"""What `import cluster_est as ce` offers: its names, results, tables, notebooks and residuals."""

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
from cluster_est.costs import COSTS
from cluster_est.errors import ProblemError, RunFolderError

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
NAMES = """
    Budget ClusterEstError Effect Experiment Input LeastSquares LoopResult LoopSettings
    Model Multistart Output Parameter Problem Resources Result Solver UncertaintySettings
    add_effect build_problem close_loop design detect fit locate read_config read_model read_problem
    read_table residuals simulate
"""


def test_the_exported_names_are_these():
    assert sorted(ce.__all__) == sorted(NAMES.split())
    assert len(ce.__all__) <= 30
    assert dir(ce) == sorted(ce.__all__)
    assert all(getattr(ce, name).__doc__ for name in ce.__all__)
    with pytest.raises(AttributeError, match="no attribute 'optimise'"):
        _ = ce.optimise


@pytest.fixture(scope="module")
def truth():
    return spring_problem(experiments=2, samples=80, noise=0.002)


@pytest.fixture(scope="module")
def result(truth):
    return ce.fit(truth.problem)


def rows(folder, table):
    return pq.read_table(folder / f"{table}.parquet").to_pylist()


def check_tables(result, folder):
    """They are those of the run folder, but for what only a log can say."""
    assert set(result.tables) == {p.stem for p in folder.glob("*.parquet")} - {
        "searches",
        "workers",
    }
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


def test_its_tables_are_arrow_tables_and_those_of_a_run_folder(tmp_path, result):
    assert isinstance(result.parameters, pa.Table)
    assert result.parameters["label"].to_pylist() == ["m", "k", "c", "x0[e0]", "x0[e1]"]
    assert result.residuals.num_rows == 160
    assert result.trajectories.num_rows >= 160
    found = result.residuals["residual"].to_numpy()
    assert np.dot(found, found) == pytest.approx(result.cost)
    with pytest.raises(RunFolderError, match="'residual'; did you mean 'residuals'"):
        result.table("residual")
    assert main(["fit", str(CONFIG), "--out", str(tmp_path / "run"), "--no-report"]) == 0
    check_tables(ce.fit(ce.read_problem(CONFIG)), tmp_path / "run")


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
    assert result.parameters.column_names == result.table("parameters").column_names
    assert result.success == result.after.success
    assert result.message == result.summary
    assert result.cost == pytest.approx(np.dot(result.fun, result.fun))
    assert result.nfev > result.nit > 0
    assert result.x == result.after.x
    assert result.jac.shape == (len(result.fun), len(result.after.solution.x))
    for shown in (html(result), str(result)):
        assert f"Closed loop: {result.verdict}." in shown


def test_it_saves_and_reports_and_exports_itself(found, tmp_path):
    result, out = found
    saved = result.save(tmp_path / "saved")
    for name in result.tables:
        assert repr(rows(saved, name)) == repr(rows(out, name)), name
    mine, theirs = (json.loads((at / "run.json").read_text()) for at in (saved, out))
    for name in ("verdict", "effects", "errors", "notes", "cost", "status"):
        assert mine[name] == theirs[name], name
    assert "bias" in result.report(tmp_path / "loop.html").read_text(encoding="utf-8")
    assert "bias" in result.export(text=True).printed[0]


def html(shown):
    """What a notebook shows."""
    return shown._repr_html_()


def test_a_problem_and_a_result_show_their_numbers(truth, result):
    assert FMU.name in html(truth.problem)
    assert f"{result.x['m']:.6g}" in html(result)
    for shown in (html(truth.problem), html(result)):
        assert "nan" not in shown
        assert not re.search(r"color|background", shown)  # light and dark notebooks alike
    lines = str(result).split("\n")
    assert lines[0].startswith("Result: ")
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
    with pytest.raises(ProblemError, match="is closed; make it again"):
        f(f.x0)


def test_the_number_of_workers_changes_no_bit_of_residuals(truth):
    answers = []
    for workers in (1, 2):
        with ce.residuals(truth.problem, ce.Resources(workers=workers)) as f:
            answers.append((f(f.x0).tobytes(), f.jac(f.x0).tobytes()))
    assert answers[0] == answers[1]


def test_what_residuals_cannot_say_is_refused(truth):
    with pytest.raises(ProblemError, match=r"cost.name: must be .sse.*'huber'"):
        ce.residuals(replace(truth.problem, cost=COSTS["huber"]()))
    fixed = tuple(replace(p, fixed=True) for p in truth.problem.parameters)
    with pytest.raises(ProblemError, match="at least one must be free"):
        ce.residuals(replace(truth.problem, parameters=fixed))
