"""The shape of an effect over its argument, with what the residuals say of it without a form."""

from __future__ import annotations

import numpy as np

from cluster_est.report.blocks import FigureBlock, with_unit
from cluster_est.report.drawing import Band, Bars, Chart, Dots, ErrorBars, Line, Mark, Plot, Scale
from cluster_est.report.folder import Row
from workers.messages import FloatArray

MARGIN = 1.5
"""Heights of a curve by which its band may be drawn beyond it: a wide one would hide it."""
EVIDENCE = (
    "Dots are what the residuals alone ask for at a few places, without any form, with 95 % bars; "
    "the line is the effect that was fitted. Where dots lie on the line, the data agree with its "
    "shape. "
)
RANGE = "The bars below count the samples of the training experiments: beyond them it is a guess."


def shape_figure(row: Row, number: int) -> FigureBlock:
    """Draw one row of shapes.parquet: the effect, its band, its evidence and its samples."""
    x, y, low, high = (np.array(row[name], float) for name in ("x", "y", "lower", "upper"))
    height = float(np.nanmax(y) - np.nanmin(y)) or abs(float(y[0])) or 1.0
    floor, ceiling = float(np.nanmin(y)) - MARGIN * height, float(np.nanmax(y)) + MARGIN * height
    known = bool(np.isfinite(low).all() and np.isfinite(high).all())
    marks: list[Mark] = []
    if known:
        wide = bool((low < floor).any() or (high > ceiling).any())
        low, high = np.clip(low, floor, ceiling), np.clip(high, floor, ceiling)
        name = "95 % band, cut off" if wide else "95 % band"
        marks.append(Band(name, "after", x, low, high))
    marks.append(Line("effect", "after", x, y))
    evidence, seen = _evidence(row, floor, ceiling)
    marks += evidence
    over = with_unit(row["variable"], row["variable_unit"])
    edges, counts = np.array(row["edges"], float), np.array(row["counts"], float)
    across = Scale.around(edges, margin=0.01)
    title = f"{row['part']} over {over}, where the training data were"
    if not known:
        title += "; the data do not determine every coefficient, so there is no band"
    upright = Scale.around(y, low[np.isfinite(low)], high[np.isfinite(high)], seen)
    samples = Scale(0.0, 1.08 * float(counts.max()) or 1.0)
    plots = (
        Plot(title, with_unit(row["part"], row["unit"]), across, upright, marks, 230),
        Plot(f"samples over {over}", "samples", across, samples,
             [Bars("", "faint", edges, counts)], 60),
    )  # fmt: skip
    note = (EVIDENCE if evidence else "") + RANGE
    return FigureBlock(f"shape-{row['effect']}-{number}", title, Chart(plots, over), note)


def _evidence(row: Row, floor: float, ceiling: float) -> tuple[list[Mark], FloatArray]:
    """What the residuals ask for without a form, if the run has that, and its ends."""
    at, free, error = (
        np.array(row.get(name) or (), float) for name in ("free_x", "free_y", "free_error")
    )
    some = np.isfinite(at) & np.isfinite(free) & (free >= floor) & (free <= ceiling)
    if not some.any():
        return [], np.zeros(0)
    at, free, spread = at[some], free[some], 1.96 * error[some]
    low, high = np.maximum(free - spread, floor), np.minimum(free + spread, ceiling)
    marks = [
        ErrorBars("", "measured", at, low, high),
        Dots("what the residuals ask for", "measured", at, free),
    ]
    return [*marks], np.concatenate([low, high])
