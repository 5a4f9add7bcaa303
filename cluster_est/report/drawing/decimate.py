"""Fewer points of a curve, without losing a peak: the extremes of each column of pixels."""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray, IntArray


def extremes(x: FloatArray, y: FloatArray, columns: int) -> IntArray:
    """Return indices into a curve that keep what is seen of it in so many columns.

    The range of x is cut into columns of equal width. Of each, the samples with the lowest and the
    highest y are kept, and the first and last of all. Samples in a column are one above the other
    when it is a pixel wide, so that only samples that others hide are left out.

    Parameters
    ----------
    x : (n,)
        Finite, in any order; it is drawn in the order of the samples.
    y : (n,)
        NaN is taken for no sample; ends of gaps are kept, so that gaps stay gaps, unless there are
        more of them than columns.
    columns
        Across the plot.

    Returns
    -------
    (k,) ascending indices, all where there are no more than two for each column
    """
    size = len(x)
    if size <= 2 * columns + 2:
        return np.arange(size)
    known = np.isfinite(y)
    kept = [np.array([0, size - 1])]
    gaps = np.flatnonzero(known[1:] != known[:-1])
    if len(gaps) <= columns:
        kept += [gaps, gaps + 1]
    at = np.flatnonzero(known)
    place = column_of(x, columns)[at]
    order = np.lexsort((at, y[at], place))
    groups = np.flatnonzero(np.diff(place[order]))
    if len(order):
        kept += [at[order[np.append(0, groups + 1)]], at[order[np.append(groups, len(order) - 1)]]]
    return np.unique(np.concatenate(kept))


def column_of(x: FloatArray, columns: int) -> IntArray:
    """The column that each sample stands in, from 0 on."""
    low, span = float(x.min()), float(np.ptp(x)) or 1.0
    return np.minimum(((x - low) / span * columns).astype(np.int64), columns - 1)
