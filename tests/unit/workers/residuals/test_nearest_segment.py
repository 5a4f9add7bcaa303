"""Distances from a curve without times: against plain loops, and what must hold for every curve."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from workers.residuals.nearest_segment import (
    farthest_components,
    segment_distances,
    tolerance_constraints,
)

Array = NDArray[np.float64]


def plain_vector(point: Array, start: Array, end: Array) -> Array:
    """The shortest way from a segment to a point, by where the point's projection falls."""
    way = end - start
    along = np.clip((point - start) @ way / (way @ way or 1.0), 0.0, 1.0)
    return np.asarray(point - start - along * way)


def plain_segment_distances(points: Array, reference: Array) -> list[float]:
    scales = [max(abs(column)) or 1.0 for column in reference.T]
    return [
        min(float(np.linalg.norm(plain_vector(point, *ends))) for point in points / scales)
        for ends in pairwise(reference / scales)
    ]


def plain_farthest_components(points: Array, reference: Array) -> Array:
    ways = [[plain_vector(point, *ends) for ends in pairwise(reference)] for point in points]
    nearest = [min(each, key=np.linalg.norm) for each in ways]  # the first of equals
    return np.asarray(np.abs(nearest).max(axis=0))


def curve(random: np.random.Generator, rows: int, columns: int) -> Array:
    """A random walk whose columns differ in size, and some of whose points repeat."""
    steps = random.normal(size=(rows, columns)) * (random.random((rows, 1)) < 0.9)
    return np.asarray(np.cumsum(steps, axis=0) * 10.0 ** random.integers(-1, 3, columns))


@pytest.mark.parametrize("columns", [1, 2, 3, 9])
@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_plain_loops(seed, columns):
    random = np.random.default_rng([seed, columns])
    reference = curve(random, 60, columns)
    points = reference[random.integers(0, 60, 80)] + random.normal(size=(80, columns))
    expected = plain_segment_distances(points, reference)
    np.testing.assert_allclose(segment_distances(points, reference), expected, rtol=0, atol=1e-12)
    farthest = plain_farthest_components(points, reference)
    np.testing.assert_allclose(
        farthest_components(points, reference), farthest, rtol=1e-12, atol=1e-12
    )


SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 4.0]])


def test_distances_to_two_sides_of_a_rectangle():
    # scaled by 2 and 4: sides from (0, 0) to (1, 0) to (1, 1), points (0.5, 0.25) and (2, 2)
    points = np.array([[1.0, 1.0], [4.0, 8.0]])
    np.testing.assert_array_equal(segment_distances(points, SQUARE), [0.25, 0.5])
    # not scaled: the first point is 1 from both sides, the second (2, 4) from the far corner
    np.testing.assert_array_equal(farthest_components(points, SQUARE), [2.0, 4.0])


def test_the_first_of_equally_near_segments_counts():
    middle = np.array([[1.0, 1.0]])
    np.testing.assert_array_equal(farthest_components(middle, SQUARE), [0.0, 1.0])
    np.testing.assert_array_equal(farthest_components(middle, SQUARE[::-1]), [1.0, 0.0])


def test_a_segment_without_length_is_a_point():
    still, point = np.full((3, 2), 2.0), np.array([[8.0, 10.0]])
    np.testing.assert_array_equal(segment_distances(point, still), [5.0, 5.0])
    np.testing.assert_array_equal(farthest_components(point, still), [6.0, 8.0])


def test_a_column_of_zeros_is_not_scaled():
    flat = np.array([[0.0, 0.0], [5.0, 0.0]])
    np.testing.assert_array_equal(segment_distances(np.array([[2.0, 7.0]]), flat), [7.0])


@pytest.mark.parametrize(
    ("tolerances", "expected"),
    [([2.0, 4.0], [1.5, -0.25]), ([0.0, 3.0], [0.0]), ([10.0, 0.0], [-0.5]), ([0.0, 0.0], [])],
)
def test_constraints_only_for_tolerances_that_are_not_zero(tolerances, expected):
    """One point is farthest in the first component, by 5, another one in the second, by 3."""
    points = np.array([[1.0, -3.0], [-5.0, 0.0]])
    np.testing.assert_array_equal(farthest_components(points, SQUARE), [5.0, 3.0])
    found = tolerance_constraints(points, SQUARE, np.array(tolerances))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [(0, 0), (3, 1), (-1, 0)])
@pytest.mark.parametrize("rest", [1.0, 1e300])
def test_points_that_are_not_finite(value, where, rest):
    points = np.full((6, 2), rest)
    points[where] = value
    for found in (
        segment_distances(points, SQUARE),
        farthest_components(points, SQUARE),
        tolerance_constraints(points, SQUARE, np.ones(2)),
    ):
        assert found.shape == (2,)
        assert not np.isfinite(found).any()


def test_points_too_large_for_their_squares():
    points = np.array([[1e300, -1e308], [-1e200, 1e160]])
    assert not np.isfinite(segment_distances(points, SQUARE)).any()
    assert farthest_components(points, SQUARE).max() >= 1e308 - 1e300


def test_points_too_far_away_for_a_difference():
    upright = np.array([[-1.7e308, 0.0], [-1.7e308, 1.0]])
    assert not np.isfinite(farthest_components(-upright, upright)).all()


def test_same_bits_in_whatever_parts_of_many_points():
    random = np.random.default_rng(3)
    reference, points = curve(random, 900, 2), curve(random, 2500, 2)
    halves = [points[:1200], points[1200:]]
    nearest = [segment_distances(each, reference) for each in halves]
    np.testing.assert_array_equal(segment_distances(points, reference), np.minimum(*nearest))
    farthest = [farthest_components(each, reference) for each in halves]
    np.testing.assert_array_equal(farthest_components(points, reference), np.maximum(*farthest))


@pytest.mark.parametrize("distances", [segment_distances, farthest_components])
def test_same_bits_in_whatever_memory(distances):
    random = np.random.default_rng(4)
    reference, points = curve(random, 20, 3), curve(random, 50, 3)
    expected = distances(points, reference)
    batch = np.zeros((50, 4, 3))
    batch[:, 2] = points
    np.testing.assert_array_equal(distances(batch[:, 2], reference), expected)
    fortran = np.asfortranarray(points), np.asfortranarray(reference)
    np.testing.assert_array_equal(distances(*fortran), expected)


def lattice(dimensions: int, least: int) -> st.SearchStrategy[Array]:
    """Curves on a lattice: differences and translations are exact, and ties do happen."""
    row = st.lists(st.integers(-64, 64), min_size=dimensions, max_size=dimensions)
    rows = st.lists(row, min_size=least, max_size=9)
    return rows.map(lambda ticks: np.array(ticks) / 8.0)


@st.composite
def curves(draw: st.DrawFn) -> tuple[Array, Array]:
    """Points and a reference with one, two or three columns."""
    dimensions = draw(st.integers(1, 3))
    return draw(lattice(dimensions, 1)), draw(lattice(dimensions, 2))


@settings(max_examples=50)
@given(curves())
def test_agrees_with_plain_loops_where_points_repeat(pair):
    expected = plain_segment_distances(*pair)
    np.testing.assert_allclose(segment_distances(*pair), expected, rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(curves(), st.lists(st.floats(0.0, 50.0), min_size=3, max_size=3))
def test_constraints_hold_exactly_where_the_components_are_within_tolerance(pair, tolerances):
    points, reference = pair
    given_tolerances = np.array(tolerances[: points.shape[1]])
    used = given_tolerances > 1e-6
    given_tolerances[~used] = 0.0
    found = tolerance_constraints(points, reference, given_tolerances)
    within = farthest_components(points, reference)[used] <= given_tolerances[used]
    np.testing.assert_array_equal(found <= 0.0, within)
