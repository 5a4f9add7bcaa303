"""Indices of functions whose indices are known, as problems without an FMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import FunctionExecutor, FunctionProblem

from cluster_est.costs.likelihood import GaussianLikelihood
from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.running.runner import Runner
from cluster_est.sensitivity.analysis import analyse_on, check_bounds
from cluster_est.sensitivity.quantities import AnalysedQuantity, with_log_cost
from cluster_est.sensitivity.settings import SensitivitySettings

A, B = 7.0, 0.1
COEFFICIENTS = np.array([0.0, 1.0, 4.5, 9.0, 99.0, 99.0])


def ishigami(x):
    return np.sin(x[0]) + A * np.sin(x[1]) ** 2 + B * x[2] ** 4 * np.sin(x[0])


def g_function(x):
    return np.prod((np.abs(4.0 * x - 2.0) + COEFFICIENTS) / (1.0 + COEFFICIENTS))


def ishigami_indices():
    """T. Ishigami, T. Homma, Proc. ISUMA (1990) 398-403, doi:10.1109/ISUMA.1990.151285."""
    v1 = 0.5 * (1.0 + B * np.pi**4 / 5.0) ** 2
    v2 = A**2 / 8.0
    v13 = 8.0 * B**2 * np.pi**8 / 225.0
    total = v1 + v2 + v13
    return np.array([v1, v2, 0.0]) / total, np.array([v1 + v13, v2, v13]) / total


def g_indices():
    """I. M. Sobol, Math. Comput. Simul. 55 (2001) 271-280."""
    parts = 1.0 / (3.0 * (1.0 + COEFFICIENTS) ** 2)
    whole = np.prod(1.0 + parts)
    return parts / (whole - 1.0), parts * whole / (1.0 + parts) / (whole - 1.0)


def problem_of(function, size, low, high):
    """Its only residual is the function's value."""
    return FunctionProblem(
        function.__name__, lambda x: np.atleast_1d(function(x)), (0.3 * low + 0.7 * high,) * size,
        0.0, (low,) * size, (high,) * size,
    )  # fmt: skip


def analysed(function, size, low, high, workers=1, seed=3, **settings):
    one = problem_of(function, size, low, high)
    with FunctionExecutor(one.residuals, workers=workers) as executor:
        space = check_bounds(one.problem())
        return analyse_on(
            Runner(executor, whole=True), space, SensitivitySettings(**settings), seed
        )


def of_output(result, index):
    return np.array([r.value for r in result.indices if r.index == index and r.output == "y"])


@pytest.mark.parametrize(
    ("function", "size", "low", "high", "truth"),
    [
        (ishigami, 3, -np.pi, np.pi, ishigami_indices()),
        (g_function, 6, 0.0, 1.0, g_indices()),
    ],
)
def test_sobol_indices_are_the_analytic_ones(function, size, low, high, truth):
    found = analysed(function, size, low, high, method="sobol", groups=4096)
    np.testing.assert_allclose(of_output(found, "first order"), truth[0], atol=0.02)
    np.testing.assert_allclose(of_output(found, "total"), truth[1], atol=0.02)


def test_the_unknowns_that_matter_are_ranked_first():
    weights = np.zeros(60)
    weights[[3, 17, 40, 55]] = [2.0, 5.0, 3.0, 4.0]

    def few_matter(x):
        return 10.0 + weights @ x + 0.5 * x[17] * x[40]

    found = analysed(few_matter, 60, 0.0, 1.0)
    assert [u.label for u in found.ranking[:4]] == ["x17", "x55", "x40", "x3"]
    assert found.ranking[4].value == 0.0
    effects = dict(zip([f"x{i}" for i in range(60)], of_output(found, "mu*"), strict=True))
    assert effects["x55"] == pytest.approx(4.0)
    assert (
        found.evaluations == 20 * 61 + 2 + 2 * 60
    )  # and the start, twice, with central differences


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_the_number_of_workers_changes_nothing(method):
    one, three = (
        analysed(ishigami, 3, -1.0, 2.0, workers=w, method=method, groups=32) for w in (1, 3)
    )
    for name in one.tables:
        rows = [repr(result.table(name).to_pylist()) for result in (one, three)]
        assert rows[0] == rows[1]  # as text: NaN is not equal to itself


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_a_failure_takes_its_group_away_and_no_more(method):
    def fails_at_times(x):
        return np.nan if x[0] > 0.9 and x[1] > 0.9 else 1.0 + x[0] + 2.0 * x[1] + 0.1 * x[2]

    found = analysed(fails_at_times, 3, 0.0, 1.0, method=method, groups=64)
    assert 0 < found.lost < found.groups == 64
    assert found.failures > 0
    assert any(f"{found.lost} of 64 groups" in note for note in found.notes)
    assert [u.label for u in found.ranking] == ["x1", "x0", "x2"]


def test_too_many_failures_are_refused():
    with pytest.raises(ProblemError, match=r"at least 4 groups of points must be simulated"):
        analysed(lambda x: np.nan, 3, 0.0, 1.0)


def test_a_quantity_that_does_not_move_has_no_index():
    found = analysed(lambda x: 1.0, 3, 0.0, 1.0, method="sobol", groups=32)
    assert np.isnan([u.value for u in found.ranking]).all()


def test_infinite_bounds_are_refused():
    one = FunctionProblem("free", lambda x: x, (1.0,), 0.0)
    with pytest.raises(ProblemError, match=r"parameters\.x0\.bounds: must be finite bounds"):
        check_bounds(one.problem())


def test_a_logarithmic_scale_needs_bounds_above_0():
    one = FunctionProblem("log", lambda x: x, (1.0,), 0.0, (0.0,), (9.0,)).problem()
    (parameter,) = one.parameters
    logarithmic = replace(one, parameters=(replace(parameter, scale="log"),))
    with pytest.raises(ProblemError, match=r"parameters\.x0\.bounds: must be bounds above 0"):
        check_bounds(logarithmic)


def test_one_unknown_alone_is_ranked():
    found = analysed(lambda x: 2.0 + x[0], 1, 0.0, 1.0)
    assert [u.label for u in found.ranking] == ["x0"]
    assert found.ranking[0].together


def test_the_logarithm_of_a_cost_is_taken_once():
    """A log likelihood is one already, whatever its sign, which depends on units."""
    quantities, values = (AnalysedQuantity("cost"),), np.array([[2.0], [8.0]])
    named, logs = with_log_cost(quantities, values, SumSquared())
    assert named[0].output == "log(cost)"
    np.testing.assert_allclose(logs[:, 0], np.log([2.0, 8.0]))
    assert with_log_cost(quantities, values, GaussianLikelihood())[0] == quantities
    assert with_log_cost(quantities, values - 3.0, SumSquared())[0] == quantities


@pytest.mark.parametrize(
    "changed",
    [{"method": "oat"}, {"groups": -1}, {"groups": 3}, {"collinearity": 0.5}],
)
def test_bad_settings_are_refused(changed):
    with pytest.raises(ProblemError, match=r"sensitivity\."):
        SensitivitySettings(**changed)
