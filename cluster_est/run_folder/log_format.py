"""The columns of an evaluation log."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from workers.messages import FloatArray, Outcome, Want, content_hash

SCHEMA = pa.schema(
    [
        ("key", pa.string()),
        ("want", pa.string()),
        ("search", pa.string()),
        ("evaluation", pa.int64()),
        ("purpose", pa.string()),
        ("experiment", pa.string()),
        ("values", pa.list_(pa.float64())),
        ("effects", pa.list_(pa.string())),
        ("status", pa.string()),
        ("message", pa.string()),
        ("cost", pa.float64()),
        ("residuals", pa.list_(pa.float64())),
        ("residuals_hash", pa.string()),
        ("constraints", pa.list_(pa.float64())),
        ("seconds", pa.float64()),
        ("worker", pa.string()),
        ("variables", pa.list_(pa.string())),
        ("times", pa.list_(pa.float64())),
        ("trajectory", pa.list_(pa.float64())),
        ("ended", pa.float64()),
        ("bound", pa.float64()),
        ("steps", pa.int64()),
    ]
)
"""`trajectory` is (times, variables), row after row, where that was wanted; `ended` is when its
answer came, in seconds since 1970, `bound` the sum of squares above which it was to end early, null
for none, and `steps` those of the solver, 0 where nobody counts them. These three are missing in
logs of versions that did not keep them, and so is `residuals_hash`, which stays where residuals
have left."""
HASH_LENGTH = 32
"""Characters of a hash of residuals: 128 bits."""
ROWS_PER_BATCH = 2000
"""Of a segment without its large columns."""
LARGE = ("residuals", "variables", "times", "trajectory")
"""Columns that can be left out: a resumed run simulates those rows again."""
NEVER_NULL = ("key", "want", "search", "purpose", "experiment", "values", "status", "message")
"""Columns that say something in each row, of those that a log has."""


def logged_cost(outcome: Outcome, want: Want) -> float:
    """The sum of squares of an outcome's residuals, NaN where there are none.

    That of absolute values where only this is known.
    """
    if outcome.residuals is None:
        return np.nan
    with np.errstate(over="ignore"):  # it may be infinite
        sizes = outcome.residuals if want == "absolutes" else outcome.residuals**2
        return float(np.add.reduce(sizes))


def residuals_hash(residuals: FloatArray | None) -> str | None:
    """The hash of residuals bit for bit, by which they are known when they are there no more."""
    return None if residuals is None else content_hash([residuals.tobytes()])[:HASH_LENGTH]
