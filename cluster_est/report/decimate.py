"""Fewer points of curves, without losing a peak of any of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from workers.messages import FloatArray, IntArray


def peaks(curves: Sequence[FloatArray], most: int) -> IntArray:
    """Return indices into curves over the same times, so that no peak of any is lost.

    The samples are cut into buckets of equal counts; of each bucket, the lowest and the highest
    sample of each curve are kept, and the first and last of all.

    Parameters
    ----------
    curves : each (n,)
        NaN is taken for no sample; ends of gaps are kept, so that gaps stay gaps.
    most
        How many points to keep, roughly; all where there are no more.

    Returns
    -------
    (k,) ascending indices
    """
    size = len(curves[0]) if curves else 0
    buckets = max(1, most // (2 * max(1, len(curves))))
    if size <= max(most, 2):
        return np.arange(size)
    edges = np.unique(np.linspace(0, size, buckets + 1).astype(np.int64))
    kept = [np.array([0, size - 1])]
    for curve in curves:
        known = np.isfinite(curve)
        gaps = np.flatnonzero(known[1:] != known[:-1])
        if len(gaps) <= buckets:
            kept += [gaps, gaps + 1]
        for way, worst in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            filled = np.where(known, curve, worst)
            found = [a + way(filled[a:b]) for a, b in pairwise(edges)]
            kept.append(np.array(found, np.int64))
    return np.unique(np.concatenate(kept))
