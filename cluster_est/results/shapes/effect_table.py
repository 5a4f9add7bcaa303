"""The curves of effects as a table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import pyarrow as pa

from cluster_est.results.fit_tables import EffectCurve

SHAPES = pa.schema(
    [
        *((name, pa.string()) for name in ("effect", "part", "variable", "variable_unit", "unit")),
        *(
            (name, pa.list_(pa.float64()))
            for name in (
                "x",
                "y",
                "lower",
                "upper",
                "edges",
                "counts",
                "free_x",
                "free_y",
                "free_error",
            )
        ),
        ("why_not", pa.string()),
    ]
)


def curve_table(curves: Sequence[EffectCurve]) -> pa.Table:
    """Return a table with a row for each curve of each effect; the points are lists."""
    return pa.Table.from_pylist([dataclasses.asdict(each) for each in curves], schema=SHAPES)
