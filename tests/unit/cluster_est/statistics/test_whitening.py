"""Coloured noise becomes white, and its coefficients are recovered."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.truth.stacked_noise import autoregressive, stack

from cluster_est.statistics.whitening import deviance, fit_autoregression, whiten

TRUE = np.array([[1.2, -0.5], [0.8, 0.0]])


def test_coefficients_are_recovered_for_each_output() -> None:
    records = stack(4000, 2000, outputs=2)
    noise = autoregressive(records, TRUE, np.random.default_rng(5))
    # standard error sqrt((1 - a_2^2) / 6000) = 0.013
    assert fit_autoregression(noise, records) == pytest.approx(TRUE, abs=0.04)


def test_an_offset_that_all_records_share_is_no_noise_that_never_forgets() -> None:
    records = stack(2000, 1000, outputs=2)
    noise = autoregressive(records, TRUE, np.random.default_rng(7))
    shifted = noise + 30.0
    assert fit_autoregression(shifted, records)[1].sum() > 0.95
    found = fit_autoregression(shifted, records, about_mean=True)
    assert found == pytest.approx(fit_autoregression(noise, records), abs=0.01)


@pytest.mark.parametrize("length", [1, 2, 3, 30])
def test_the_filter_is_an_exact_root_of_the_inverse_covariance(length: int) -> None:
    # autocovariances of an AR(2) of innovation variance 1, from Yule-Walker
    a, b = TRUE[0]
    covariances = [(1.0 - b) / ((1.0 + b) * ((1.0 - b) ** 2 - a**2))]
    covariances.append(covariances[0] * a / (1.0 - b))
    while len(covariances) < length:
        covariances.append(a * covariances[-1] + b * covariances[-2])
    covariance = toeplitz(covariances[:length])
    root = whiten(np.eye(length), stack(length), TRUE[:1])
    np.testing.assert_allclose(root @ covariance @ root.T, np.eye(length), atol=1e-10)


def test_records_do_not_mix_and_columns_are_independent() -> None:
    records = stack(20, 9, 1)
    matrix = np.random.default_rng(7).standard_normal((30, 3))
    white = whiten(matrix, records, TRUE[:1])
    assert white.shape == matrix.shape
    for column in range(3):
        np.testing.assert_allclose(white[:, column], whiten(matrix[:, column], records, TRUE[:1]))
    np.testing.assert_allclose(white[20:29], whiten(matrix[20:29], stack(9), TRUE[:1]))


def test_white_and_vanishing_residuals_stay_as_they_are() -> None:
    records = stack(40)
    assert fit_autoregression(np.zeros(40), records).tolist() == [[0.0, 0.0]]
    noise = np.random.default_rng(8).standard_normal(40)
    assert whiten(noise, records, np.zeros((1, 2))).tolist() == noise.tolist()
    assert whiten(noise, records, np.zeros((1, 0))).tolist() == noise.tolist()


def test_a_perfectly_smooth_residual_gives_a_stationary_autoregression() -> None:
    records = stack(500)
    for residuals in (np.ones(500), np.sin(np.linspace(0.0, 3.0, 500))):
        whitened = whiten(residuals, records, fit_autoregression(residuals, records))
        assert np.isfinite(whitened).all()


def test_an_unstable_autoregression_is_refused() -> None:
    with pytest.raises(ValueError, match="not stationary"):
        whiten(np.zeros(10), stack(10), np.array([[0.5, 1.1]]))


def test_the_deviance_of_white_noise_is_that_of_each_output() -> None:
    records = stack(4000, 2000, outputs=2)
    noise = autoregressive(records, TRUE, np.random.default_rng(8))
    rows = [records.of_output(output) for output in range(2)]
    plain = sum(len(noise[r]) * np.log(np.mean(noise[r] ** 2)) for r in rows)
    assert deviance(noise, records) == pytest.approx(plain)


@pytest.mark.parametrize("length", [5, 40])
def test_the_deviance_is_that_of_a_normal_distribution(length: int) -> None:
    """With an autoregression of first order, whose covariances are a^k / (1 - a^2)."""
    records = stack(length, length + 3)
    slope = np.array([[0.8]])
    noise = autoregressive(records, slope, np.random.default_rng(2))
    total, squares = 0.0, 0.0
    for item in records.items:
        part = noise[item.rows]
        covariance = toeplitz(0.8 ** np.arange(len(part)) / (1.0 - 0.8**2))
        total += np.linalg.slogdet(covariance)[1]
        squares += part @ np.linalg.solve(covariance, part)
    expected = total + len(noise) * np.log(squares / len(noise))  # the variance is estimated along
    assert deviance(noise, records, slope) == pytest.approx(expected)
