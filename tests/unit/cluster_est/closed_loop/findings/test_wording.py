"""What was found, in words and numbers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.truth.stacked_noise import stack

from cluster_est.closed_loop.findings.wording import _largest_difference, error_changes, where_left


def errors(rmse, normalised):
    return SimpleNamespace(
        errors=(
            SimpleNamespace(
                experiment="e0", role="train", output="y0", unit="m", samples=50,
                rmse_after=rmse, normalised_after=normalised,
            ),
        )
    )  # fmt: skip


def changes(sigma, noise):
    output = SimpleNamespace(sigma=sigma)
    bench = SimpleNamespace(
        problem=SimpleNamespace(experiments=[SimpleNamespace(outputs=[output])]),
        noise_in_units=lambda found: {"y0": noise},
    )
    found = SimpleNamespace(noise=None)
    (row,) = error_changes(bench, found, errors(0.6, 0.6 / sigma), errors(0.2, 0.2 / sigma))
    assert (row.rmse_before, row.rmse_after) == (0.6, 0.2)
    return row.normalised_before, row.normalised_after


def test_errors_are_over_the_given_sigma_or_else_over_the_noise():
    assert changes(0.5, 0.1) == pytest.approx((1.2, 0.4))
    assert changes(1.0, 0.1) == pytest.approx((6.0, 2.0))


@pytest.mark.parametrize("noise", [0.0, np.nan])
def test_without_noise_there_is_nothing_to_be_over(noise):
    assert np.isnan(changes(1.0, noise)).all()


def test_where_two_models_differ_most_for_their_noise():
    """The larger difference is in y0, whose noise is larger still."""
    records = stack(50, 50, outputs=2)
    experiments = [SimpleNamespace(id=f"run {i}") for i in range(3)]
    bench = SimpleNamespace(
        records=records, problem=SimpleNamespace(experiments=experiments), train=(0, 2)
    )
    one, other = np.zeros(200), np.zeros(200)
    other[10] = -8.0
    other[150 + 49] = 2.0  # second experiment, y1, last sample
    where, when, output, size = _largest_difference(
        bench, SimpleNamespace(residuals=one), SimpleNamespace(residuals=other),
        np.array([4.0, 0.5]),
    )  # fmt: skip
    assert (where, output) == ("run 2", "y1")
    assert (when, size) == pytest.approx((1.0, 4.0))


def test_where_and_when_most_of_a_residual_lives():
    records = stack(100, 100)
    experiments = [SimpleNamespace(id=f"run {i}") for i in range(2)]
    bench = SimpleNamespace(
        records=records, problem=SimpleNamespace(experiments=experiments), train=(0, 1)
    )
    residuals = np.ones(200)
    residuals[100 + 41 : 100 + 44] = 10.0
    fitted = SimpleNamespace(residuals=residuals, sse=float(residuals @ residuals))
    said = where_left(bench, fitted)
    assert "output y0 of experiment 'run 1'" in said
    assert f"({302 / (197 + 300):.0%})" in said
    start, stop = (float(x) for x in said.split("t = ")[1].removesuffix(" s").split(" and "))
    times = records.items[1].times
    assert start <= times[41] < times[43] <= stop
