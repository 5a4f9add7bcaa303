"""A projection removes exactly the span of its columns."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.statistics.projection import OrthogonalProjection

GENERATOR = np.random.default_rng(4)
MATRIX = GENERATOR.standard_normal((60, 4))
SIGNALS = GENERATOR.standard_normal((60, 7))


def test_it_is_idempotent_and_removes_its_columns() -> None:
    projection = OrthogonalProjection(MATRIX)
    left = projection.remove(SIGNALS)
    assert (projection.rank, projection.degrees) == (4, 56)
    np.testing.assert_allclose(projection.remove(left), left, atol=1e-13)
    np.testing.assert_allclose(projection.remove(MATRIX), 0.0, atol=1e-12)
    np.testing.assert_allclose(projection.remove(SIGNALS[:, 2]), left[:, 2], atol=1e-13)


def test_it_equals_the_residual_of_least_squares() -> None:
    fit = np.linalg.lstsq(MATRIX, SIGNALS, rcond=None)[0]
    expected = SIGNALS - MATRIX @ fit
    np.testing.assert_allclose(OrthogonalProjection(MATRIX).remove(SIGNALS), expected, atol=1e-12)


def test_scales_of_columns_are_irrelevant() -> None:
    scaled = MATRIX * np.array([1e-12, 1.0, -1e9, 3.0])
    expected = OrthogonalProjection(MATRIX).remove(SIGNALS)
    np.testing.assert_allclose(OrthogonalProjection(scaled).remove(SIGNALS), expected, atol=1e-12)


def test_dependent_and_zero_columns_do_not_count() -> None:
    extended = np.column_stack([MATRIX, MATRIX @ np.ones(4), np.zeros(60)])
    projection = OrthogonalProjection(extended)
    assert projection.rank == 4
    np.testing.assert_allclose(projection.remove(extended), 0.0, atol=1e-12)


@pytest.mark.parametrize("matrix", [np.zeros((60, 0)), np.zeros((60, 2))])
def test_without_columns_nothing_is_removed(matrix: np.ndarray) -> None:
    projection = OrthogonalProjection(matrix)
    assert (projection.rank, projection.degrees) == (0, 60)
    assert projection.remove(SIGNALS).tolist() == SIGNALS.tolist()
