import numpy as np
import pytest
from scipy.linalg import toeplitz
from support.truth.stacked_noise import autoregressive, stack

from cluster_est.statistics.residual_findings import (
    ResidualDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)
from cluster_est.statistics.residual_tests import ResidualTests
from cluster_est.statistics.whitening import deviance, fit_autoregression, whiten

WHITE, MISSING = ResidualStructure.WHITE, ResidualStructure.MISSING
RELATED = ResidualStructure.AUTOCORRELATED
NONE, SMALL = SigmaDoubt.NONE, SigmaDoubt.TOO_SMALL
LARGE, OUTLIERS = SigmaDoubt.TOO_LARGE, SigmaDoubt.OUTLIERS

RECORDS = stack(300, 200)
TIMES = np.concatenate([np.arange(300.0), np.arange(200.0)])
WHITE_NOISE = np.random.default_rng(5).normal(size=500)
COLOURED = autoregressive(RECORDS, np.array([[0.8]]), np.random.default_rng(6)) * 0.6
WAVE = 4.0 * np.sin(TIMES / 15.0)
SPIKES = np.where(np.random.default_rng(7).uniform(size=500) < 0.02, 15.0, 0.0)


def diagnose(residuals, records=RECORDS, *, declared=True, exact=False) -> ResidualDiagnostics:
    count = len(records.outputs)
    tests = ResidualTests(
        residuals, records, np.zeros((records.size, 0)), (declared,) * count, (exact,) * count
    )
    return ResidualDiagnostics(*tests.run())


@pytest.mark.parametrize(
    ("residuals", "structure", "doubt"),
    [
        (WHITE_NOISE, WHITE, NONE),
        (1.15 * WHITE_NOISE, WHITE, NONE),
        (10.0 * WHITE_NOISE, WHITE, SMALL),
        (0.1 * WHITE_NOISE, WHITE, LARGE),
        (WHITE_NOISE + SPIKES, WHITE, OUTLIERS),
        (COLOURED, RELATED, NONE),
        (0.1 * COLOURED, RELATED, LARGE),
        (WHITE_NOISE + WAVE, MISSING, NONE),
        (WHITE_NOISE + 0.1 * WAVE, RELATED, NONE),
        (10.0 * (WHITE_NOISE + 0.25 * WAVE), RELATED, SMALL),
        (0.1 * (WHITE_NOISE + WAVE), RELATED, LARGE),
    ],
)
def test_what_follows_from_structure_and_size(residuals, structure, doubt):
    found = diagnose(residuals)
    assert [(o.structure, o.sigma) for o in found.outputs] == [(structure, doubt)]
    assert found.too_narrow == (structure is MISSING or (structure is RELATED and bool(doubt)))
    assert bool(found.findings) == (structure is not WHITE or bool(doubt))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_without_a_sigma_the_size_says_nothing(scale):
    assert diagnose(scale * WHITE_NOISE, declared=False).findings == ()
    (found,) = diagnose(scale * (WHITE_NOISE + WAVE), declared=False).findings
    assert (found.structure, found.sigma) == (RELATED, NONE)
    assert found.rms_over_noise == pytest.approx(np.sqrt(1.0 + 8.0), rel=0.15)


def test_figures_of_an_output():
    (found,) = diagnose(WHITE_NOISE + WAVE).outputs
    assert found.samples == 500
    assert found.rms_over_sigma == pytest.approx(np.sqrt(np.mean((WHITE_NOISE + WAVE) ** 2)))
    assert found.noise_over_sigma == pytest.approx(1.0, abs=0.15)
    assert found.lag1 == pytest.approx(8.0 / 9.0, abs=0.03)
    assert found.p < 1e-20


def test_numerical_errors_and_few_samples_are_not_judged():
    assert diagnose(WHITE_NOISE + WAVE, exact=True).findings == ()
    nothing = diagnose(np.zeros(500))
    assert nothing.findings == ()
    assert (nothing.outputs[0].lag1, nothing.outputs[0].widening) == (0.0, 1.0)
    few = diagnose(100.0 * np.linspace(-1.0, 1.0, 12), stack(12))
    assert few.findings == ()
    assert few.outputs[0].structure is ResidualStructure.NOT_TESTED


def test_white_noise_in_few_or_many_samples_gives_no_alarm():
    generator = np.random.default_rng(8)
    for records in (stack(24), stack(10, 10, 10, 10), stack(40, outputs=2), stack(200, outputs=3)):
        alarms = [diagnose(generator.normal(size=records.size), records) for _ in range(60)]
        assert sum(bool(each.findings) for each in alarms) <= 1, records


@pytest.mark.slow
def test_what_the_parameters_have_taken_out_counts():
    """White noise behind a fit of many directions is neither small nor smooth."""
    generator = np.random.default_rng(9)
    basis = np.linalg.qr(generator.normal(size=(500, 400)))[0]
    left = WHITE_NOISE - basis @ (basis.T @ WHITE_NOISE)
    known = ResidualDiagnostics(*ResidualTests(left, RECORDS, basis, (True,), (False,)).run())
    assert known.outputs[0].rms_over_sigma == pytest.approx(1.0, abs=0.2)
    assert known.findings == ()
    assert diagnose(left).outputs[0].sigma is LARGE


def test_each_output_is_judged_and_all_together():
    records = stack(400, outputs=3)
    residuals = np.random.default_rng(10).normal(size=1200)
    residuals[records.of_output(1)] += 2.0 * np.sin(np.arange(400) / 15.0)
    found = diagnose(residuals, records)
    assert [o.output for o in found.findings] == ["y1"]
    assert found.together is not None
    assert found.together.structure is not WHITE


def test_what_no_output_shows_alone_all_may_show_together():
    records = stack(300, outputs=6)
    residuals = np.random.default_rng(11).normal(size=1800)
    residuals += 0.32 * np.tile(np.sin(np.arange(300) / 20.0), 6)
    found = diagnose(residuals, records)
    assert all(o.structure is WHITE for o in found.outputs)
    assert [o.output for o in found.findings] == ["all outputs together"]


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_first_order_noise_has_the_autocorrelation_of_theory(rho):
    records = stack(10_000, 10_000)
    noise = autoregressive(records, np.array([[rho]]), np.random.default_rng(0))
    (found,) = diagnose(7.0 * noise, records).outputs
    assert found.lag1 == pytest.approx(rho, abs=0.02)
    assert found.widening == pytest.approx(np.sqrt((1 + rho) / (1 - rho)), rel=0.1)


def test_no_correlation_spans_two_records():
    records = stack(2, 2)
    (found,) = diagnose(np.array([1.0, -1.0, -1.0, 1.0]), records).outputs
    assert found.lag1 == pytest.approx(-0.5)
    assert found.widening == 1.0


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
