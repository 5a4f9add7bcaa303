"""Speed of the distances between curves without times, against plain loops.

    python scripts/bench_nearest_segment.py [--points 1000] [--reference 1000] [--rounds 50]

Prints the median of interleaved runs in one process and thread. The loops walk over Python floats,
one segment and one point at a time, and take seconds: they run once in ten rounds.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from workers.residuals.nearest_segment import farthest_components, segment_distances

Array = NDArray[np.float64]
Vector = list[float]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--points", type=int, default=1000)
    arguments.add_argument("--reference", type=int, default=1000)
    arguments.add_argument("--rounds", type=int, default=50)
    options = arguments.parse_args()
    points, reference = hysteresis(options.points, 0.0), hysteresis(options.reference, 0.1)
    compare("segment_distances", segment_distances, loop_over_segments, points, reference, options)
    compare(
        "farthest_components", farthest_components, loop_over_points, points, reference, options
    )


def hysteresis(count: int, error: float) -> Array:
    """Three noisy cycles of a loop that is 2 wide and 2 high."""
    phase = np.linspace(0.0, 6.0 * np.pi, count)
    noise = np.random.default_rng(1).normal(0.0, 0.01, (count, 2))
    return np.column_stack([np.sin(phase), np.sin(phase + 0.5 + error)]) + noise


def compare(
    name: str,
    distances: Callable[[Array, Array], Array],
    loops: Callable[[Array, Array], Vector],
    points: Array,
    reference: Array,
    options: argparse.Namespace,
) -> None:
    ours, theirs = [], []
    difference = 0.0
    for number in range(options.rounds):
        begin = time.perf_counter()
        found = distances(points, reference)
        ours.append(time.perf_counter() - begin)
        if number % 10 == 0:
            begin = time.perf_counter()
            expected = loops(points, reference)
            theirs.append(time.perf_counter() - begin)
            difference = float(np.abs(found - expected).max())
    median, plain = statistics.median(ours), statistics.median(theirs)
    print(
        f"{name:20s} {len(points)} x {len(reference)} points   {median * 1e3:6.2f} ms   "
        f"plain loops {plain * 1e3:7.0f} ms   ratio {plain / median:4.0f}   "
        f"largest difference {difference:.1e}"
    )


def loop_over_segments(points: Array, reference: Array) -> Vector:
    scales = np.abs(reference).max(axis=0)
    scaled = (points / scales).tolist()
    return [
        min(math.hypot(*vector(point, start, end)) for point in scaled)
        for start, end in pairwise((reference / scales).tolist())
    ]


def loop_over_points(points: Array, reference: Array) -> Vector:
    farthest, chain = [0.0] * reference.shape[1], reference.tolist()
    for point in points.tolist():
        ways = [vector(point, start, end) for start, end in pairwise(chain)]
        nearest = min(ways, key=lambda way: math.hypot(*way))
        farthest = [max(f, abs(component)) for f, component in zip(farthest, nearest, strict=True)]
    return farthest


def vector(point: Vector, start: Vector, end: Vector) -> Vector:
    """From the nearest place on a segment to a point."""
    along = [b - a for a, b in zip(start, end, strict=True)]
    away = [p - a for p, a in zip(point, start, strict=True)]
    squared = sum(a * a for a in along)
    place = sum(p * a for p, a in zip(away, along, strict=True)) / squared if squared else 0.0
    place = min(max(place, 0.0), 1.0)
    return [p - place * a for p, a in zip(away, along, strict=True)]


if __name__ == "__main__":
    main()
