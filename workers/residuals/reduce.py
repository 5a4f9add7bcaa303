"""One number in place of the residuals of an output, so that little must be sent.

For methods that look at nothing but a cost which is a sum over residuals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from workers.messages import FloatArray, Want


def reduce_residuals(residuals: FloatArray, counts: Sequence[int], want: Want) -> FloatArray:
    """Reduce the residuals of one simulation, output by output.

    Parameters
    ----------
    residuals : (sum of counts,)
        Of the outputs, one after the other.
    counts
        How many each has, as `Experiment.counts` says.
    want
        "squares" for the root of the sum of squares, "absolutes" for the sum of absolute values.

    Returns
    -------
    (k,)
        One number for each output that has residuals, as `Experiment.counts_in` says.
    """
    squares = want == "squares"
    sizes = residuals * residuals if squares else np.abs(residuals)  # contiguous, for the same bits
    filled = [count for count in counts if count]
    ends = np.cumsum(filled, dtype=np.intp).tolist()
    parts = zip(filled, ends, strict=True)
    sums = np.array([np.add.reduce(sizes[end - count : end]) for count, end in parts], np.float64)
    return np.sqrt(sums) if squares else sums
