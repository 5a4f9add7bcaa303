"""Paths of SVG in whole numbers: a few bytes for each point, and exact enough to be read back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from cluster_est.report.drawing.scale import UNITS
from workers.messages import FloatArray, IntArray

FARTHEST = 100 * UNITS
"""Places beyond this are cut off: a browser draws them in single precision."""


def places(x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Whole places of points whose y grows upwards, and which of the points these are."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    across = np.clip(np.rint(x[known]), -FARTHEST, FARTHEST).astype(np.int64)
    down = np.clip(np.rint(UNITS - y[known]), -FARTHEST, FARTHEST).astype(np.int64)
    return across, down, known


def line(x: FloatArray, y: FloatArray) -> str:
    """A line through places; it is broken where one of them is NaN."""
    across, down, known = places(x, y)
    parts = []
    breaks = np.flatnonzero(np.diff(known) > 1) + 1
    for part_x, part_y in zip(np.split(across, breaks), np.split(down, breaks), strict=True):
        if len(part_x):
            steps = np.column_stack([np.diff(part_x), np.diff(part_y)])
            moved = steps[(steps != 0).any(axis=1)]
            rest = _joined(moved.ravel().tolist()) if len(moved) else "0 0"
            parts.append(f"M{part_x[0]} {part_y[0]}l{rest}")
    return "".join(parts)


def dots(x: FloatArray, y: FloatArray) -> str:
    """A line without length at each place; round ends make a dot of it."""
    across, down, _ = places(x, y)
    return "".join(f"M{a} {b}h0" for a, b in zip(across.tolist(), down.tolist(), strict=True))


def outline(x: FloatArray, low: FloatArray, high: FloatArray) -> str:
    """An area between two lines over the same places."""
    return line(np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])) + "z"


def boxes(corners: Iterable[Sequence[float]]) -> str:
    """Rectangles, each from its left, right, lower and upper place."""
    parts = []
    for left, right, low, high in corners:
        a, b = round(left), round(right)
        top, bottom = round(UNITS - high), round(UNITS - low)
        parts.append(f"M{a} {top}H{b}V{bottom}H{a}z")
    return "".join(parts)


def _joined(numbers: Iterable[int]) -> str:
    """Numbers with a space between, where there is no sign to tell them apart."""
    return " ".join(map(str, numbers)).replace(" -", "-")
