"""Noise that is not white: against formulas, dense algebra and repeated simulation."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.stats import t as student
from support.problems.curves import Curves

from cluster_est import Parameter
from cluster_est.uncertainty import assess
from cluster_est.uncertainty.covariance.noise_covariance import (
    AutoregressiveNoise,
    NoiseRecord,
    fit_noise,
)

TIMES = np.linspace(0.0, 1.0, 60)


def autoregressive(generator, length, phi):
    """First order, of variance 1, from its first sample on."""
    noise = generator.normal(size=length)
    noise[1:] *= np.sqrt(1.0 - phi**2)
    return lfilter([1.0], [1.0, -phi], noise)


def line(times, values, experiment):
    """A shared slope, and an offset that each experiment has."""
    slope, offset = values
    return offset + (1.0 + 0.1 * experiment) * slope * times


def lines(seed, phi, count=4, spread=0.0):
    generator = np.random.default_rng(seed)
    measured = [
        line(TIMES, (2.0 + spread * generator.normal(), 0.3 * e), e)
        + 0.1 * autoregressive(generator, len(TIMES), phi)
        for e in range(count)
    ]
    parameters = (
        Parameter("slope", 1.0, (-100.0, 100.0)),
        Parameter("offset", 0.0, (-100.0, 100.0), per="experiment"),
    )
    return Curves(line, parameters, TIMES, measured)


def intervals(seed, phi, **options):
    _, space, solution = lines(seed, phi, **options).solve()
    return assess(space, solution), solution


class TestAutoregression:
    def test_its_product_is_that_of_the_dense_covariance(self):
        noise = AutoregressiveNoise(np.array([0.6]), 0.6 ** np.arange(80), 0.0)
        columns = np.random.default_rng(0).normal(size=(30, 3))
        expected = toeplitz(0.6 ** np.arange(30)) @ columns
        np.testing.assert_allclose(noise.times(columns), expected, rtol=1e-10, atol=1e-12)

    @pytest.mark.parametrize("coefficients", [(0.5,), (0.9,), (1.4, -0.7), (-0.6,)])
    def test_order_and_coefficients_of_a_long_record(self, coefficients):
        noise = np.random.default_rng(1).normal(size=20_000)
        values = lfilter([1.0], np.r_[1.0, -np.array(coefficients)], noise)
        record = NoiseRecord(0, values, np.zeros((len(values), 0)), 0)
        found = fit_noise([record], 0)[0]
        np.testing.assert_allclose(found.coefficients, coefficients, atol=0.03)

    @pytest.mark.slow
    def test_what_a_fit_took_of_the_noise_is_given_back(self):
        """A line in each of many short records takes much of it: more than half of g_1."""
        generator = np.random.default_rng(2)
        basis, _ = np.linalg.qr(np.column_stack([np.ones(15), np.arange(15.0)]))
        records = []
        for e in range(400):
            noise = autoregressive(generator, 15, 0.8)
            records.append(NoiseRecord(0, noise - basis @ (basis.T @ noise), basis, e))
        left = sum(float(r.residuals[1:] @ r.residuals[:-1]) for r in records) / (400 * 14)
        found = fit_noise(records, 0)[0]
        assert left < 0.5 * 0.8
        assert found.covariances[0] == pytest.approx(1.0, abs=0.15)
        assert found.covariances[1] == pytest.approx(0.8, abs=0.15)

    def test_white_noise_is_left_white(self):
        generator = np.random.default_rng(3)
        orders = [
            len(fit_noise([NoiseRecord(0, values, np.zeros((100, 0)), 0)], 0)[0].coefficients)
            for values in generator.normal(size=(200, 100))
        ]
        assert np.mean(np.array(orders) > 0) < 0.05

    @pytest.mark.parametrize("values", [np.zeros(50), np.ones(50), np.zeros(1), np.ones(3)])
    def test_residuals_without_noise_break_nothing(self, values):
        found = fit_noise([NoiseRecord(0, values, np.zeros((len(values), 0)), 0)], 0)[0]
        assert np.isfinite(found.times(values[:, None])).all()


@pytest.fixture(scope="module")
def different():
    """Of twelve experiments whose slopes differ."""
    return intervals(2, 0.0, count=12, spread=0.5)


class TestBasis:
    def test_white_noise_has_the_textbook_error(self):
        found, solution = intervals(0, 0.0)
        count, size = solution.jacobian.shape
        inverse = np.linalg.inv(solution.jacobian.T @ solution.jacobian)
        expected = np.sqrt(np.diag(inverse) * solution.cost / (count - size))
        assert found.basis == "white"
        np.testing.assert_allclose([i.std_error for i in found.intervals], expected, rtol=1e-9)
        assert all(np.isnan(i.error_autoregression) for i in found.intervals)
        assert found.notes == ()

    def test_coloured_noise_is_allowed_for_and_said(self):
        """By the sandwich of the dense Jacobian with the covariance of the noise."""
        found, solution = intervals(1, 0.9)
        jacobian, q = solution.jacobian, np.linalg.qr(solution.jacobian)[0]
        rows = [slice(60 * e, 60 * e + 60) for e in range(4)]
        left = solution.at.residuals
        records = [NoiseRecord(0, left[own], q[own], e) for e, own in enumerate(rows)]
        noise = fit_noise(records, q.shape[1])[0]
        bread = np.linalg.inv(jacobian.T @ jacobian)
        filling = sum(jacobian[own].T @ noise.times(jacobian[own]) for own in rows)
        expected = np.sqrt(np.diag(bread @ filling @ bread))
        errors = [each.error_autoregression for each in found.intervals]
        np.testing.assert_allclose(errors, expected, rtol=1e-6)
        assert found.basis == "autoregression"
        for each in found.intervals:
            assert each.std_error == each.error_autoregression > 2.0 * each.error_white
        ratios = [each.std_error / each.error_white for each in found.intervals]
        (note,) = found.notes
        said = f"autocorrelated.* are {min(ratios):.2g} to {max(ratios):.2g} times as large"
        assert re.search(said, note)

    def test_experiments_that_differ_are_allowed_for_and_said(self, different):
        found, _ = different
        slope, *offsets = found.intervals
        assert found.basis == "experiments"
        assert slope.std_error == slope.error_experiments > 2.0 * slope.error_white
        assert all(each.std_error > each.error_white for each in offsets)
        assert found.basis_degrees == 11
        ratio = slope.std_error / slope.error_white
        said = f"12 experiments differ by more than their noise.* are {ratio:.2g} times as large"
        assert re.search(said, found.notes[-1])

    def test_few_experiments_are_reported_only(self):
        found, _ = intervals(2, 0.0, count=4, spread=0.5)
        assert found.basis != "experiments"
        assert found.intervals[0].error_experiments > found.intervals[0].error_white

    def test_the_scatter_of_experiments_is_the_sandwich_of_the_dense_jacobian(self, different):
        found, solution = different
        jacobian, r = solution.jacobian, solution.at.residuals
        bread = np.linalg.inv(jacobian.T @ jacobian)
        rows = np.arange(12 * len(TIMES)).reshape(12, -1)
        moved = np.array([bread @ (jacobian[own].T @ r[own]) for own in rows])
        expected = np.sqrt(12 / 11 * np.sum(moved[:, 0] ** 2))
        assert found.intervals[0].error_experiments == pytest.approx(expected, rel=1e-9)

    def test_the_scale_of_the_residuals_changes_no_decision(self):
        curves = lines(4, 0.7)
        one, other = (
            assess(*replace(curves, measured=[factor * m for m in curves.measured]).solve()[1:])
            for factor in (1.0, 10.0)
        )
        for a, b in zip(one.intervals, other.intervals, strict=True):
            assert b.std_error == pytest.approx(10.0 * a.std_error, rel=1e-6)
        assert one.basis == other.basis == "autoregression"


@pytest.mark.parametrize("phi", [0.0, pytest.param(0.5, marks=pytest.mark.slow), 0.9])
def test_intervals_hold_the_truth_as_often_as_they_say(phi):
    """Of 150 repetitions; the bounds are three standard errors of the share."""
    basis = np.column_stack([np.ones(100), np.linspace(-1.0, 1.0, 100)])
    q, r = np.linalg.qr(np.vstack([basis] * 4))
    to_estimates = np.linalg.solve(r, q.T)
    generator = np.random.default_rng(5)
    held = []
    for _ in range(150):
        noise = np.concatenate([autoregressive(generator, 100, phi) for _ in range(4)])
        left = noise - q @ (q.T @ noise)
        rows = [slice(100 * e, 100 * e + 100) for e in range(4)]
        records = [NoiseRecord(0, left[own], q[own], e) for e, own in enumerate(rows)]
        found = fit_noise(records, 2)[0]
        spread = sum(to_estimates[:, own] @ found.times(to_estimates[:, own].T) for own in rows)
        width = student.ppf(0.975, 2.0 / found.variance_error)
        held.append(np.abs(to_estimates @ noise) <= width * np.sqrt(np.diag(spread)))
    share = np.mean(held, axis=0)
    assert (share > 0.95 - 3.0 * 0.018).all()
    assert share.mean() < 0.99
