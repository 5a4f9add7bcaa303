"""Free values recover what acts at a site, whatever its form."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.findings.free_values import free_values
from workers.effects.site import EffectSite

TIMES = np.linspace(0.0, 10.0, 2001)
SIGMA = 0.01


def trajectory(phase: float) -> LinearisedTrajectory:
    """An experiment with one output that is measured at every time, and no linear system."""
    y = 2.0 * np.sin(3.0 * TIMES + phase)
    count = len(TIMES)
    return LinearisedTrajectory(
        times=TIMES,
        signals={"y": y},
        outputs=y[:, None],
        names=("y",),
        linear=None,
        rows=np.arange(count),
        columns=np.zeros(count, int),
        sigmas=np.full(count, SIGMA),
    )


def bent(y: np.ndarray) -> np.ndarray:
    """What the output lacks: linear to both sides of a kink at the middle of its range."""
    return np.where(y > 0.0, 0.3 * y, -0.1 * y)


@pytest.fixture
def runs() -> list[LinearisedTrajectory]:
    return [trajectory(0.0), trajectory(1.0)]


def residuals(runs: list[LinearisedTrajectory], noise: float) -> np.ndarray:
    generator = np.random.default_rng(3)
    missing = np.concatenate([bent(run.outputs[:, 0]) for run in runs])
    return (missing + noise * generator.normal(size=len(missing))) / SIGMA


def test_what_an_output_lacks_is_found_within_its_bars(runs):
    site, values = EffectSite("output", "y"), [run.outputs[:, 0] for run in runs]
    found = free_values(site, runs, values, residuals(runs, 0.02))
    assert found is not None
    at, free, error = found
    assert (at[0], at[-1]) == pytest.approx((-2.0, 2.0), abs=1e-3)
    assert len(at) == 12
    far = np.abs(at) > 0.4  # a piecewise linear function cuts the corner of the kink
    assert np.all(np.abs(free - bent(at))[far] < 4.0 * error[far] + 0.01)
    assert np.all((error > 0.0) & (error < 0.01))


def test_the_bars_grow_with_the_noise(runs):
    site, values = EffectSite("output", "y"), [run.outputs[:, 0] for run in runs]
    small, large = (
        free_values(site, runs, values, residuals(runs, noise))[2] for noise in (0.05, 0.5)
    )
    assert large / small == pytest.approx(np.full(len(small), 10.0), rel=0.1)


def test_an_experiment_without_the_argument_says_nothing(runs):
    site = EffectSite("output", "y")
    wrong = residuals(runs, 0.02)
    wrong[len(TIMES) :] = 0.0  # the second one has nothing to say of the output's argument
    both = [runs[0].outputs[:, 0], None]
    at, free, _ = free_values(site, runs, both, wrong)
    far = np.abs(at) > 0.4
    assert free[far] == pytest.approx(bent(at)[far], abs=0.02)


@pytest.mark.parametrize("site", [EffectSite("pair", "a", "b"), EffectSite("derivative", "y")])
def test_a_site_whose_directions_are_not_known_has_none(runs, site):
    values = [run.outputs[:, 0] for run in runs]
    assert free_values(site, runs, values, residuals(runs, 0.02)) is None


def test_an_argument_that_never_moves_has_none(runs):
    still = [np.ones(len(TIMES))] * 2
    assert free_values(EffectSite("output", "y"), runs, still, residuals(runs, 0.02)) is None
