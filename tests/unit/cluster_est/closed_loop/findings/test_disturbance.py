"""What nothing explains is described by its size and its spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import made_bench, made_fit, made_problem

from cluster_est.closed_loop.findings.disturbance import readable_time, unexplained_residuals

LENGTHS = (1001, 801)
SIGMA = 0.2


def described(signal, noise_of: float = 1.0):
    """A signal over time (each record lasts 1 s), in white noise, described."""
    problem = made_problem(*LENGTHS, sigma=SIGMA)
    random = np.random.default_rng(3)
    parts = [signal(np.linspace(0.0, 1.0, n)) + random.standard_normal(n) for n in LENGTHS]
    fitted = made_fit(problem, np.concatenate(parts))
    (found,) = unexplained_residuals(made_bench(problem), fitted, np.array([noise_of]))
    return found


def test_size_and_period_of_a_wave():
    found = described(lambda t: 5.0 * np.sin(2.0 * np.pi * 8.0 * t))
    assert found.over_noise == pytest.approx(5.0 / np.sqrt(2.0), rel=0.05)
    assert found.size == pytest.approx(SIGMA * 5.0 / np.sqrt(2.0), rel=0.05)
    assert found.period == pytest.approx(1.0 / 8.0, rel=0.1)
    assert "most of it with a period of" in found.sentence


def test_a_broad_spectrum_has_no_period():
    random = np.random.default_rng(5)
    found = described(
        lambda t: np.interp(t, np.linspace(0.0, 1.0, 41), 6.0 * random.normal(size=41))
    )
    assert np.isnan(found.period)
    assert 0.03 < found.shortest_period < 0.2
    assert "nine tenths of it with periods above" in found.sentence


def test_noise_alone_has_no_size():
    assert described(lambda t: 0.0 * t, noise_of=1.1).size == 0.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0032, "0.0032 s"), (90.0, "90 s"), (300.0, "5 min"), (86_400.0, "24 h"), (6e5, "6.94 d")],
)
def test_times_are_in_the_unit_that_reads_well(seconds, text):
    assert readable_time(seconds) == text
