"""What `import cluster_est as ce` offers: its names, results, tables, notebooks and residuals."""

from __future__ import annotations

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
from cluster_est.costs.robust import HuberCost
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


def test_another_name_is_refused():
    with pytest.raises(AttributeError, match="no attribute 'optimise'"):
        _ = ce.optimise


@pytest.fixture(scope="module")
def truth():
    return spring_problem(experiments=2, samples=80, noise=0.002)


@pytest.fixture(scope="module")
def result(truth):
    return ce.fit(truth.problem)


class TestResult:
    def test_it_has_the_fields_of_scipy(self, truth, result):
        assert result.success
        assert result.message == "converged"
        assert result.nit == result.solution.iterations
        assert result.nfev == result.evaluations > result.nit
        assert result.x["k"] == pytest.approx(truth.values["k"], rel=0.05)
        assert np.dot(result.fun, result.fun) == pytest.approx(result.cost)
        assert result.jac.shape == (160, 5)

    def test_its_tables_are_those_of_a_run_folder(self, tmp_path):
        out = tmp_path / "run"
        assert main(["fit", str(CONFIG), "--out", str(out)]) == 0
        found = ce.fit(ce.read_problem(CONFIG))
        written = {path.stem for path in out.glob("*.parquet")} - {"searches", "workers"}
        assert set(found.tables) == written
        for name in found.tables:
            mine, theirs = found.table(name), pq.read_table(out / f"{name}.parquet")
            assert mine.schema == theirs.schema, name
            assert repr(mine.to_pylist()) == repr(theirs.to_pylist()), name  # NaN equals NaN

    def test_residuals_and_parameters_are_arrow_tables(self, truth, result):
        assert isinstance(result.parameters, pa.Table)
        assert result.parameters["label"].to_pylist() == ["m", "k", "c", "x0[e0]", "x0[e1]"]
        assert result.residuals.num_rows == 160
        assert result.trajectories.num_rows >= 160
        found = result.residuals["residual"].to_numpy()
        assert np.dot(found, found) == pytest.approx(result.cost)

    def test_a_table_that_it_has_not_is_a_sentence(self, result):
        with pytest.raises(RunFolderError, match="but is 'residual'; did you mean 'residuals'"):
            result.table("residual")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A sensor that reads too much, as a result and as a run folder."""
    out = tmp_path_factory.mktemp("loop") / "run"
    changes = [f"experiments.{i}.columns.position.offset=0.1" for i in range(5)]
    changes += ["closed_loop.effects=['bias']", "closed_loop.max_effects=1"]
    assert main(["close-loop", str(CONFIG), *changes, "--out", str(out)]) == 0
    problem = ce.read_problem(CONFIG, changes)
    settings = ce.LoopSettings(forms=("bias",), max_effects=1)
    return ce.close_loop(problem, settings=settings), out


class TestLoopResult:
    def test_its_tables_are_those_of_a_run_folder(self, found):
        result, out = found
        assert [effect.form for effect in result.effects] == ["bias"]
        written = {path.stem for path in out.glob("*.parquet")} - {"searches", "workers"}
        assert set(result.tables) == written
        for name in result.tables:
            rows = pq.read_table(out / f"{name}.parquet").to_pylist()
            assert repr(result.table(name).to_pylist()) == repr(rows), name  # NaN is not NaN
        assert result.parameters.column_names == result.table("parameters").column_names

    def test_it_has_the_fields_of_scipy(self, found):
        result, _ = found
        assert result.success == result.after.success
        assert result.message == result.summary
        assert result.cost == pytest.approx(np.dot(result.fun, result.fun))
        assert result.nfev > result.nit > 0
        assert result.x == result.after.x
        assert result.jac.shape == (len(result.fun), len(result.after.solution.x))

    def test_a_notebook_shows_the_verdict(self, found):
        result, _ = found
        assert f"Closed loop: {result.verdict}." in result._repr_html_()
        assert str(result).startswith(f"Closed loop: {result.verdict}.")

    def test_it_saves_and_reports_and_exports_itself(self, found, tmp_path):
        result, out = found
        saved = result.save(tmp_path / "saved")
        for name in result.tables:
            mine, theirs = (pq.read_table(at / f"{name}.parquet") for at in (saved, out))
            assert repr(mine.to_pylist()) == repr(theirs.to_pylist()), name
        mine, theirs = (json.loads((at / "run.json").read_text()) for at in (saved, out))
        for name in ("verdict", "effects", "errors", "notes", "cost", "status"):
            assert mine[name] == theirs[name], name
        assert "bias" in result.report(tmp_path / "loop.html").read_text(encoding="utf-8")
        exported = result.export(text=True)
        assert "bias" in exported.printed[0]


class TestNotebook:
    def test_what_is_shown_is_escaped(self, truth):
        problem = truth.problem
        named = replace(problem.experiments[0], id="<script>x</script>")
        problem = replace(problem, experiments=(named, *problem.experiments[1:]))
        shown = problem._repr_html_()
        assert "<script" not in shown
        assert "&lt;script&gt;" in shown

    def test_a_problem_and_a_result_show_their_numbers(self, truth, result):
        assert FMU.name in truth.problem._repr_html_()
        assert f"{result.x['m']:.6g}" in result._repr_html_()
        for shown in (truth.problem._repr_html_(), result._repr_html_()):
            assert "nan" not in shown
            assert not re.search(r"color|background", shown)  # light and dark notebooks alike

    def test_print_shows_aligned_tables(self, result):
        lines = str(result).split("\n")
        assert lines[0].startswith("Result: ")
        head = lines.index("Parameters") + 1
        (row,) = (line for line in lines if line.startswith("m "))
        at = lines[head].index("value")
        assert row[at:].split()[0] == f"{result.x['m']:.6g}"

    def test_long_tables_are_cut_and_say_so(self, truth):
        many = tuple(replace(truth.problem.experiments[0], id=f"r{i}") for i in range(60))
        shown = replace(truth.problem, experiments=many)._repr_html_()
        assert "and 10 more" in shown
        assert "r49" in shown
        assert "r50" not in shown


class TestResiduals:
    def test_scipy_reaches_what_fit_reaches(self, truth, result):
        with ce.residuals(truth.problem) as f:
            found = scipy.optimize.least_squares(f, f.x0, jac=f.jac, bounds=f.bounds, xtol=1e-12)
            assert f.names == ("m", "k", "c", "x0[e0]", "x0[e1]")
            values = f.physical(found.x)
        assert 2.0 * found.cost == pytest.approx(result.cost, rel=1e-8)
        assert values == pytest.approx(result.x, rel=1e-4, abs=1e-6)

    def test_a_logarithmic_unknown_is_the_logarithm(self, truth):
        with ce.residuals(truth.problem) as f:
            assert f.x0[1] == pytest.approx(np.log(20.0))
            assert f.bounds[1][1] == pytest.approx(np.log(200.0))
            assert f.physical(f.x0)["k"] == pytest.approx(20.0)

    def test_the_derivatives_are_those_of_scipy(self, truth):
        with ce.residuals(truth.problem, differences="central") as f:
            x = f.x0 + 0.01
            expected = scipy.optimize.approx_fprime(x, f, 1e-6)
            assert f.jac(x) == pytest.approx(expected, rel=1e-3, abs=1e-3)

    def test_a_point_that_fails_is_nan_and_says_why(self, truth):
        with ce.residuals(truth.problem) as f:
            x = f.x0
            x[0] = np.inf
            assert np.isnan(f(x)).all()
            assert f(x).shape == (160,)
            assert np.isnan(f.jac(x)).all()
            assert "parameter 'm' is inf" in f.reason
            assert np.isfinite(f(f.x0)).all()

    def test_the_number_of_workers_changes_no_bit(self, truth):
        answers = []
        for workers in (1, 2):
            with ce.residuals(truth.problem, ce.Resources(workers=workers)) as f:
                answers.append((f(f.x0).tobytes(), f.jac(f.x0).tobytes()))
        assert answers[0] == answers[1]

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"cost": HuberCost()}, "cost.name: must be \"sse\" .* but is 'huber'"),
            ({"fixed": True}, "at least one must be free"),
        ],
    )
    def test_what_residuals_cannot_say_is_refused(self, truth, change, said):
        problem = truth.problem
        if "fixed" in change:
            kept = tuple(replace(p, fixed=True) for p in problem.parameters)
            problem = replace(problem, parameters=kept)
        with pytest.raises(ProblemError, match=said):
            ce.residuals(replace(problem, cost=change.get("cost", problem.cost)))

    def test_misuse_is_a_sentence(self, truth):
        f = ce.residuals(truth.problem)
        with pytest.raises(ProblemError, match=r"x must have 5 numbers .* but has shape \(2,\)"):
            f([1.0, 2.0])
        f.close()
        with pytest.raises(ProblemError, match="is closed; make it again"):
            f(f.x0)
