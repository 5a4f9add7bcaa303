"""Distances between a simulated curve and a measured curve that has an order but no times.

The measured curve, the *reference*, is a chain of straight segments. The simulated curve is a set
of points. Two distances are needed. The distance of each segment to its nearest point shows whether
the simulation reaches all measurements. The distance of each point to its nearest segment shows
whether the simulation leaves the measured curve.

With A and B the ends of a segment and P a point, the distance vector of P from the segment is

    r(P, AB) = P - A - t (B - A),    t = (P - A).(B - A) / |B - A|^2,  not below 0 nor above 1

A segment of length 0 is a point, with t = 0 instead of 0/0. Such segments are common, because
measured curves often repeat values.

Source: the example "Estimate Model Parameters Using Time-Independent Data" of the Simulink Design
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from workers.messages import FloatArray

MAX_PAIRS = 16_384
"""Number of pairs of a point and a segment processed at once, so that they fit into a core's
cache."""


class ReferenceSegments(NamedTuple):
    """The segments of a reference, with one row for each dimension, so that rows are contiguous.

    Attributes
    ----------
    starts, vectors : (d, n)
        A and B - A.
    weights : (d, n)
        (B - A) / |B - A|^2, whose product with P - A is t; 0 for a segment of length 0.
    """

    starts: FloatArray
    vectors: FloatArray
    weights: FloatArray


@np.errstate(over="ignore", invalid="ignore")  # overflow is reported as not finite
def segment_distances(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the distance of each segment of the reference to the nearest simulated point.

    These are the residuals of a fit to a curve without times. All columns have equal weight,
    because points and reference are first divided by s_j = max_i |reference_ij| (1 if this is 0):

        d_i = min_k | r(P_k / s, A_i B_i / s) |

    They do not penalise points far from all segments: see `tolerance_constraints`. The minimum over
    points has kinks at changes of the nearest point, which become smaller with denser sampling.

    Parameters
    ----------
    points : (m, d)
        The simulated curve, at least one point, in any order.
    reference : (n, d)
        The measured curve in its order, finite.

    Returns
    -------
    (n - 1,)
        Dimensionless distances. All of them are NaN if any point is not finite.
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
    """Return the largest distance of the simulated points from the reference, along each column.

        c_j = max_k | r_j(P_k, nearest segment of P_k) |

    Nothing is scaled: if the columns differ much in size, the largest one determines the nearest
    segment. Of equally near segments, the first counts. Different points may give the maxima.

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
    """Return the relative violation of the tolerances around the reference by a simulated curve.

        g_j = c_j / tolerance_j - 1,    c = farthest_components(points, reference)

    A fit of `segment_distances` needs g_j <= 0, because those residuals do not penalise a
    simulation that leaves the measured curve.

    Parameters
    ----------
    points : (m, d)
        The simulated curve, at least one point, in any order.
    reference : (n, d)
        The measured curve in its order, finite, at least two points.
    tolerances : (d,)
        In the columns' units, not negative; 0 for a column without a tolerance.

    Returns
    -------
    (number of tolerances that are not 0,)
        Dimensionless, in the order of the columns. NaN if any point is not finite.
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
    """Yield the distances of blocks of points from every segment.

    All operations are elementwise, so the results do not depend on the blocks.

    Yields
    ------
    vectors : (d, some, n)
        r(P, AB); overwritten by the next block.
    squares : (some, n)
        |r(P, AB)|^2; overwritten by the next block.
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
    """Write distance vectors, and their squared lengths to `sums`; `work` is scratch."""
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
