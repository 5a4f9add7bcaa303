"""Distances between a simulated curve and a measured one that has no times, only an order.

The measured curve, the *reference*, is a chain of straight segments; the simulated one is a set of
points. Both distances are needed: each segment to its nearest point says whether the simulation
reaches all that was measured, each point to its nearest segment whether it goes anywhere else.

With A and B the ends of a segment and P a point, the distance vector of P from the segment is

    r(P, AB) = P - A - t (B - A),    t = (P - A).(B - A) / |B - A|^2,  not below 0 nor above 1

A segment without length is a point: t = 0. The formula has 0/0 there, and measured curves do repeat
values.

Source: the example "Estimate Model Parameters Using Time-Independent Data" of the Simulink Design
Optimization documentation defines both distances, the scaling and the tolerance constraint.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from workers.messages import FloatArray

MAX_PAIRS = 16_384
"""Pairs of a point and a segment that are worked on at once: few enough for a core's own cache."""


class ReferenceSegments(NamedTuple):
    """The pieces of a reference; one row a dimension, so that all segments are contiguous.

    Attributes
    ----------
    starts, vectors : (d, n)
        A and B - A.
    weights : (d, n)
        (B - A) / |B - A|^2, whose product with P - A is t; 0 for a segment without length.
    """

    starts: FloatArray
    vectors: FloatArray
    weights: FloatArray


@np.errstate(over="ignore", invalid="ignore")  # what overflows is not finite, and says so itself
def segment_distances(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return how far each segment of the reference is from the nearest simulated point.

    The residuals of a fit to a curve without times. Every column counts the same, because points
    and reference are first divided by s_j = max_i |reference_ij| (1 where that is 0):

        d_i = min_k | r(P_k / s, A_i B_i / s) |

    They say nothing about points that are near no segment: see `tolerance_constraints`. A minimum
    over points has kinks where the nearest one changes; they vanish as the simulated curve is
    sampled more densely.

    Parameters
    ----------
    points : (m, d)
        The simulated curve, at least one point, in any order.
    reference : (n, d)
        The measured curve in its order, finite.

    Returns
    -------
    (n - 1,)
        Distances, without a unit. All of them are NaN if any point is not finite.
    """
    if not np.isfinite(points).all():
        return np.full(len(reference) - 1, np.nan)
    scales = _scales(reference)
    nearest = np.full(len(reference) - 1, np.inf)
    for _, squares in _distances(points / scales, _segments(reference / scales)):
        np.minimum(nearest, squares.min(axis=0), out=nearest)
    return np.asarray(np.sqrt(nearest))


@np.errstate(over="ignore", invalid="ignore")
def farthest_components(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return how far from the reference the simulated points get, along each column.

        c_j = max_k | r_j(P_k, nearest segment of P_k) |

    Nothing is scaled: where columns differ much in size, the largest decides which segment is the
    nearest. Of segments equally near it is the first. Different points may give the maxima.

    Parameters
    ----------
    points : (m, d)
        The simulated curve, at least one point, in any order.
    reference : (n, d)
        The measured curve in its order, finite, at least two points.

    Returns
    -------
    (d,)
        Distances in the columns' units. All of them are NaN if any point is not finite.
    """
    farthest = np.zeros(reference.shape[1])
    if not np.isfinite(points).all():
        return np.full_like(farthest, np.nan)
    for vectors, squares in _distances(points, _segments(reference)):
        nearest = squares.argmin(axis=1)
        components = np.abs(vectors[:, np.arange(len(nearest)), nearest])
        np.maximum(farthest, components.max(axis=1), out=farthest)
    return farthest


@np.errstate(over="ignore", invalid="ignore")
def tolerance_constraints(
    points: FloatArray, reference: FloatArray, tolerances: FloatArray
) -> FloatArray:
    """Return by how much a simulated curve leaves the tube around the reference.

        g_j = c_j / tolerance_j - 1,    c = farthest_components(points, reference)

    To be kept at or below 0 in a fit of `segment_distances`, which alone leaves the simulation free
    to go where nothing was measured.

    Parameters
    ----------
    points : (m, d)
        The simulated curve, at least one point, in any order.
    reference : (n, d)
        The measured curve in its order, finite, at least two points.
    tolerances : (d,)
        In the columns' units, not negative; 0 for a column that has none.

    Returns
    -------
    (number of tolerances that are not 0,)
        Without a unit, in the order of the columns. NaN if any point is not finite.
    """
    used = tolerances != 0
    return np.asarray(farthest_components(points, reference)[used] / tolerances[used] - 1.0)


def _scales(reference: FloatArray) -> FloatArray:
    largest = np.abs(reference).max(axis=0)
    largest[largest == 0.0] = 1.0
    return np.asarray(largest)


def _segments(reference: FloatArray) -> ReferenceSegments:
    starts = np.ascontiguousarray(reference[:-1].T)
    vectors = np.ascontiguousarray(np.diff(reference, axis=0).T)
    squares = np.add.reduce(vectors * vectors, axis=0)
    weights = np.divide(vectors, squares, out=np.zeros_like(vectors), where=squares > 0.0)
    return ReferenceSegments(starts, vectors, weights)


def _distances(
    points: FloatArray, segments: ReferenceSegments
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Give the distances of some points at a time from every segment.

    Elementwise throughout: no result depends on how the points are cut.

    Yields
    ------
    vectors : (d, some, n)
        r(P, AB); overwritten by the next.
    squares : (some, n)
        |r(P, AB)|^2; overwritten by the next.
    """
    dimensions, count = segments.starts.shape
    rows = max(1, min(len(points), MAX_PAIRS // max(1, count)))
    buffers = np.empty((dimensions + 2, rows, count))
    for first in range(0, len(points), rows):
        some = points[first : first + rows]
        ready = buffers[:, : len(some)]
        _fill(some, segments, ready[:-2], ready[-2], ready[-1])
        yield ready[:-2], ready[-2]


def _fill(
    points: FloatArray,
    segments: ReferenceSegments,
    vectors: FloatArray,
    sums: FloatArray,
    work: FloatArray,
) -> None:
    """Write distance vectors, and their squared lengths into `sums`; `work` is scratch."""
    starts, directions, weights = segments
    for vector, column, start in zip(vectors, points.T, starts, strict=True):
        np.subtract(column[:, None], start, out=vector)
    _dot(vectors, weights, sums, work)
    places = np.clip(sums, 0.0, 1.0, out=sums)
    for vector, direction in zip(vectors, directions, strict=True):
        vector -= np.multiply(places, direction, out=work)
    _dot(vectors, vectors, sums, work)


def _dot(vectors: FloatArray, others: FloatArray, sums: FloatArray, work: FloatArray) -> None:
    np.multiply(vectors[0], others[0], out=sums)
    for vector, other in zip(vectors[1:], others[1:], strict=True):
        sums += np.multiply(vector, other, out=work)
