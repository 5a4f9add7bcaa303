"""Estimates by name, matrices, criteria, frames, text: against SciPy, and as a folder has them."""

import math
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy.optimize
from scipy.stats import norm
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.errors import ProblemError, RunFolderError
from cluster_est.results.criteria import InformationCriteria, information_criteria

NOISE = 0.002


def with_sigma(problem, sigma):
    runs = tuple(
        replace(run, outputs=tuple(replace(o, sigma=sigma) for o in run.outputs))
        for run in problem.experiments
    )
    return replace(problem, experiments=runs)


@pytest.fixture(scope="module")
def problem():
    made = spring_problem(experiments=3, samples=120, noise=NOISE).problem
    *train, last = with_sigma(made, NOISE).experiments
    return replace(made, experiments=(*train, replace(last, role="test")))


@pytest.fixture(scope="module")
def result(problem):
    return ce.fit(problem, uncertainty={"profiles": "k"})


@pytest.fixture(scope="module")
def stiff(problem):
    """A model whose damping is wrong."""
    return ce.fit(problem.with_values({"c": 0.3}).fix("c"))


def test_a_parameter_is_reached_by_its_name(result):
    k = result.params["k"]
    assert k.value == result.x["k"]
    assert k.interval[0] < k.value < k.interval[1]
    assert k.stderr == pytest.approx((k.interval[1] - k.interval[0]) / (2.0 * 1.9706), rel=1e-2)
    assert (k.unit, k.description) == ("N/m", "stiffness of the spring")
    assert list(result.params) == ["m", "k", "c", "x0[e0]", "x0[e1]", "x0[e2]"]
    with pytest.raises(KeyError, match=r"no parameter 'K'"):
        result.params["K"]


def test_the_covariance_is_that_of_curve_fit(problem, result):
    """Of the same residuals, with derivatives of SciPy; the logarithm of k is what moves."""
    with ce.residuals(problem) as f:
        start = np.array([math.log(result.x[n]) if n == "k" else result.x[n] for n in f.names])
        zeros = np.zeros(len(f(start)))
        x, found = scipy.optimize.curve_fit(
            lambda _, *x: -f(np.array(x)), zeros, zeros, start, method="trf"
        )
    units = np.array([math.exp(v) if n == "k" else 1.0 for n, v in zip(f.names, x, strict=True)])
    expected = found * np.outer(units, units)
    for i, one in enumerate(f.names[:3]):
        assert result.params[one].stderr == pytest.approx(math.sqrt(expected[i, i]), rel=0.01)
        for j, other in enumerate(f.names):
            got = result.covariance[one, other]
            assert got == pytest.approx(expected[i, j], rel=0.02, abs=0.01 * abs(expected).min())


def test_matrices_are_symmetric_and_name_their_entries(result):
    names = result.correlation.names
    matrix = np.asarray(result.correlation)
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(np.diag(matrix), 1.0)
    assert result.correlation["m", "k"] > 0.9
    assert math.isnan(result.correlation["x0[e0]", "x0[e1]"])
    frame = result.correlation.to_frame()
    assert list(frame.columns) == list(frame.index) == list(names)
    assert frame.loc["m", "k"] == result.correlation["m", "k"]
    with pytest.raises(KeyError, match=r"no 'q'"):
        result.covariance["m", "q"]


def test_criteria_with_a_known_sigma_are_those_of_the_normal_density(result):
    left = np.concatenate([r["measured"].to_numpy() - r["simulated"].to_numpy() for _, r in
                           trained(result)])  # fmt: skip
    likelihood = norm.logpdf(left, scale=NOISE).sum()
    k, n = 5, len(left)
    assert n == 240
    assert result.criteria.log_likelihood == pytest.approx(likelihood, rel=1e-9)
    assert result.aic == pytest.approx(2 * k - 2 * likelihood, rel=1e-9)
    assert result.aicc - result.aic == pytest.approx(2 * k * (k + 1) / (n - k - 1))
    assert result.bic - result.aic == pytest.approx(k * (math.log(n) - 2))


def trained(result):
    table = result.to_frame("residuals")
    return table[table["role"] == "train"].groupby("experiment")


def test_criteria_without_a_sigma_estimate_one_for_all(problem):
    bare = with_sigma(problem, 1.0)
    residuals = NOISE * np.random.default_rng(5).normal(size=240)
    found = information_criteria(bare, residuals, 5)
    own = norm.logpdf(residuals, scale=np.sqrt(np.mean(residuals**2))).sum()
    assert found.log_likelihood == pytest.approx(own)
    assert found.estimated == 6


def test_criteria_of_the_likelihood_estimate_a_sigma_for_each_output(problem):
    def seen(run):
        (y,) = run.outputs
        return replace(run, outputs=(replace(y, sigma=1.0), replace(y, variable="v", sigma=1.0)))

    runs = tuple(map(seen, problem.experiments))
    residuals = np.random.default_rng(5).normal(size=480)
    by_output = residuals.reshape(2, 2, 120) * np.array([1.0, 30.0])[None, :, None]
    found = information_criteria(
        replace(problem, experiments=runs, cost="likelihood"), by_output.ravel(), 5
    )
    own = sum(
        norm.logpdf(by_output[:, i], scale=np.sqrt(np.mean(by_output[:, i] ** 2))).sum()
        for i in (0, 1)
    )
    assert found.log_likelihood == pytest.approx(own)
    assert found.estimated == 7


def test_where_the_cost_is_no_likelihood_there_are_no_criteria(problem):
    mass = problem.parameters[0]
    prior = replace(mass, prior=ce.NormalPrior(1.2, 0.1))
    cases = {
        "cost 'huber'": replace(problem, cost="huber"),
        "priors add": replace(problem, parameters=(prior, *problem.parameters[1:])),
    }
    for said, each in cases.items():
        found = information_criteria(each, np.ones(240), 5)
        assert said in found.why_not
        assert math.isnan(found.aic)
    assert "could be simulated" in information_criteria(problem, None, 5).why_not
    assert InformationCriteria.of(0.0, 6, 5).aicc == math.inf


def test_the_right_model_is_the_better_one(result, stiff):
    found = ce.compare({"wrong": stiff, "right": result})
    assert found.best == "right"
    right, wrong = found.models
    assert right.aic_difference == right.bic_difference == 0.0
    assert wrong.aic_difference == pytest.approx(stiff.aic - result.aic)
    assert right.aic_weight + wrong.aic_weight == pytest.approx(1.0)
    assert (right.estimated, wrong.estimated) == (5, 4)
    assert right.held_out == result.rmse("test") < wrong.held_out
    assert any("wrong: the residuals are not white noise" in note for note in found.notes)
    assert "wrong" in repr(found)
    assert list(found.to_frame()["model"]) == ["right", "wrong"]
    assert ce.compare(stiff, result).best == "2"


def test_models_of_other_data_are_not_compared(problem, result):
    *runs, last = problem.experiments
    fewer = ce.fit(replace(problem, experiments=(runs[0], last)))
    with pytest.raises(ProblemError, match=r"same measured values"):
        ce.compare(result, fewer)
    with pytest.raises(ProblemError, match=r"at least two"):
        ce.compare(result)
    with pytest.raises(ProblemError, match=r"compare: a: must be a ResultView.*3"):
        ce.compare({"a": 3, "b": result})


def test_tables_come_as_frames(result):
    frame = result.to_frame()
    assert isinstance(frame, pd.DataFrame)
    assert frame.set_index("label").loc["k", "value"] == result.x["k"]
    assert len(result.to_frame("residuals")) == 360


def test_without_pandas_a_sentence_says_what_to_do(result, monkeypatch):
    table = result.table("parameters")
    monkeypatch.setattr(type(result), "table", lambda *_: Unconvertible())
    with pytest.raises(ProblemError, match=r"needs pandas.*pip install pandas, or use table\(\)"):
        result.to_frame()
    assert table.num_rows == 6


class Unconvertible:
    def to_pandas(self):
        raise ImportError("No module named 'pandas'")


def test_texts_are_short_and_the_summary_says_all(problem, result):
    for each in (problem, result):
        assert len(repr(each)) < 160
    assert f"k={result.x['k']:.6g}" in repr(result)
    text = result.summary()
    assert text == str(result)
    for said in ("Fit: converged", "stiffness of the spring", f"AIC {result.aic:.6g}", "held out"):
        assert said in text or said == "held out"
    assert all(note in text for note in result.notes)


def test_what_was_saved_is_loaded(result, stiff, tmp_path):
    found = ce.load(ce.save(result, tmp_path / "run"))
    assert sorted(found.tables) == sorted(result.tables)
    for name in result.tables:
        assert repr(found.table(name).to_pylist()) == repr(result.table(name).to_pylist()), name
    assert found.params["k"] == result.params["k"]
    assert found.covariance == result.covariance
    assert found.criteria == result.criteria
    assert found.summary() == result.summary()
    assert (found.x, found.cost, found.message) == (result.x, result.cost, result.message)
    assert (found.success, found.notes) == (True, result.notes)
    assert ce.compare({"right": found, "wrong": stiff}).best == "right"
    with pytest.raises(RunFolderError, match=r"table: must be one of.*'residual'"):
        found.table("residual")
    with pytest.raises(RunFolderError, match=r"must be the folder of a run"):
        ce.load(tmp_path)


def test_plots_take_axes_and_return_them(result):
    matplotlib = pytest.importorskip("matplotlib", reason="plots need matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    _, ax = pyplot.subplots()
    assert result.plot("e1", ax=ax) is ax
    measured, before, simulated = ax.get_lines()
    table = result.to_frame("residuals")
    own = table[table["experiment"] == "e1"]
    np.testing.assert_array_equal(measured.get_ydata(), own["measured"])
    assert simulated.get_label() == "simulated"
    assert before.get_label() == "before"
    errors = result.to_frame("errors")
    worst = errors.loc[errors["normalised_after"].idxmax(), "experiment"]
    assert result.plot().get_title().startswith(worst)
    residuals = result.plot_residuals("e2")
    assert residuals.get_title() == "e2, held out"
    np.testing.assert_array_equal(
        residuals.get_lines()[-1].get_ydata(), table[table["experiment"] == "e2"]["residual"]
    )
    image = result.plot_correlation().images[0].get_array()
    np.testing.assert_array_equal(np.asarray(image), np.asarray(result.correlation))
    profile = result.plot_profile("k")
    assert profile.get_xlabel() == "k [N/m]"
    assert result.profiles[0].lower in [line.get_xdata()[0] for line in profile.get_lines()]
    for call in (lambda: result.plot("e9"), lambda: result.plot_profile("m")):
        with pytest.raises(ProblemError, match=r"this result has no"):
            call()
    pyplot.close("all")


def test_without_matplotlib_a_sentence_says_what_to_install(result, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ProblemError, match=r"needs matplotlib.*cluster-est\[plot\]"):
        result.plot()


def test_draws_go_to_arviz_a_walker_a_chain(problem):
    drawn = ce.fit(problem, uncertainty={"posterior": 40}).posterior
    assert drawn is not None
    pytest.importorskip("arviz", reason="ArviZ is an extra: pip install 'cluster-est[arviz]'")
    found = drawn.to_arviz()
    steps, walkers, _ = drawn.values.shape
    k = found["posterior"]["k"]
    assert k.shape == (walkers, steps)
    np.testing.assert_array_equal(np.asarray(k), drawn.values[:, :, drawn.labels.index("k")].T)
    assert found["sample_stats"]["lp"].shape == (walkers, steps)


def test_without_arviz_a_sentence_says_what_to_install(problem, monkeypatch):
    drawn = ce.fit(problem, uncertainty={"posterior": 40}).posterior
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ProblemError, match=r"needs ArviZ.*cluster-est\[arviz\]"):
        drawn.to_arviz()
