"""A projection removes exactly the span of its columns."""

import numpy as np
import pytest

from cluster_est.statistics.projection import OrthogonalProjection

GENERATOR = np.random.default_rng(4)
MATRIX = GENERATOR.standard_normal((60, 4))
SIGNALS = GENERATOR.standard_normal((60, 7))


@pytest.mark.parametrize(
    "matrix",
    [
        MATRIX,
        MATRIX * np.array([1e-12, 1.0, -1e9, 3.0]),
        np.column_stack([MATRIX, MATRIX @ np.ones(4), np.zeros(60)]),
    ],
    ids=["independent", "of other scales", "dependent"],
)
def test_it_leaves_the_residual_of_least_squares(matrix: np.ndarray) -> None:
    projection = OrthogonalProjection(matrix)
    assert (projection.rank, projection.degrees) == (4, 56)
    expected = SIGNALS - MATRIX @ np.linalg.lstsq(MATRIX, SIGNALS, rcond=None)[0]
    left = projection.remove(SIGNALS)
    np.testing.assert_allclose(left, expected, atol=1e-12)
    np.testing.assert_allclose(projection.remove(SIGNALS[:, 2]), left[:, 2], atol=1e-13)


@pytest.mark.parametrize("columns", [0, 2])
def test_without_columns_nothing_is_removed(columns: int) -> None:
    projection = OrthogonalProjection(np.zeros((60, columns)))
    assert (projection.rank, projection.degrees) == (0, 60)
    assert projection.remove(SIGNALS).tolist() == SIGNALS.tolist()
