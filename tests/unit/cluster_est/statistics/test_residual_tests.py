"""What is said of residuals that were made to be white, coloured, structured or of another size."""

import numpy as np
import pytest
from support.truth.stacked_noise import autoregressive, stack

from cluster_est.statistics.residual_findings import (
    ResidualDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)
from cluster_est.statistics.residual_tests import ResidualTests

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
