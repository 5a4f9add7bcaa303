"""What counts as the noise of an output."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import made_bench, made_problem

from cluster_est.closed_loop.measured_noise import noise_of


@pytest.mark.parametrize(
    ("length", "sigma", "expected"),
    [(9, 0.5, 1.0), (9, 1.0, 10.0), (400, 0.5, 10.0)],
    ids=["short, with a sigma", "short, without one", "long, with a wrong sigma"],
)
def test_records_too_short_to_show_their_noise_have_the_sigma_that_is_given(
    length: int, sigma: float, expected: float
) -> None:
    problem = made_problem(*(length,) * 4, sigma=sigma)
    residual = np.random.default_rng(3).standard_normal(4 * length)
    residual *= 10.0 / np.sqrt(np.mean(residual**2))
    assert noise_of(made_bench(problem), residual)[0] == pytest.approx(expected, rel=0.1)
