"""Measured, before, after and residual curves of every experiment."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.report.blocks import ExplorerBlock, ReportSection, TextBlock, with_unit
from cluster_est.report.decimate import peaks
from cluster_est.report.encode import doubles, floats
from cluster_est.report.folder import ReportedRun
from cluster_est.report.numbers import count
from workers.messages import FloatArray

MOST_POINTS = 80_000
"""Of all curves together: about 32 bytes each in the page."""
FEWEST, MOST = 100, 20_000
"""Points of one output of one experiment."""


def curves(run: ReportedRun) -> ReportSection:
    """All experiments, of which the page shows one."""
    table = run.residuals
    if table is None or not table.num_rows:
        return ReportSection("curves", "Curves", ())
    measured, simulated = _parts(table), _parts(run.trajectories)
    units = {row["output"]: row["unit"] for row in run.tables["errors"]}
    most = int(np.clip(MOST_POINTS / max(1, len(measured)), FEWEST, MOST))
    found: dict[str, dict[str, Any]] = {}
    samples, drawn = 0, 0
    for (experiment, output), part in measured.items():
        unit = units.get(output, "")
        panel, size, kept = _panel(part, simulated.get((experiment, output)), output, unit, most)
        role = part["role"][0].as_py()
        entry = found.setdefault(experiment, {"id": experiment, "role": role, "outputs": []})
        entry["outputs"].append(panel)
        samples, drawn = samples + size, drawn + kept
    how = (
        "Every sample is drawn."
        if samples == drawn
        else f"Of {count(samples)} samples {count(drawn)} are drawn: the lowest and the highest of "
        "each curve in each short stretch, so that no peak is lost."
    )
    text = TextBlock(f"Before: {run.before}. Drag to zoom, double-click to see all. {how}")
    return ReportSection(
        "curves", "Measured and simulated", (text, ExplorerBlock(tuple(found.values())))
    )


def _panel(
    table: pa.Table, finer: pa.Table | None, output: str, unit: str, most: int
) -> tuple[dict[str, Any], int, int]:
    """One output of one experiment, with how many samples it has and how many are drawn."""
    time, measured, after, before = (
        _column(table, name) for name in ("time", "measured", "simulated", "simulated_before")
    )
    panel: dict[str, Any] = {"name": output, "label": with_unit(output, unit), "unit": unit}
    if not np.isfinite(time).any():  # a distance to a curve belongs to no time
        distances = _column(table, "residual")
        kept = peaks([distances], most)
        panel |= {"segment": doubles(kept.astype(float)), "distance": floats(distances[kept])}
        return panel, len(distances), len(kept)
    curves = [c for c in (measured, after, before, measured - after) if np.isfinite(c).any()]
    kept = peaks(curves, most)
    panel |= {"t": doubles(time[kept]), "measured": floats(measured[kept])}
    for name, curve in (("after", after), ("before", before)):
        if np.isfinite(curve).any():
            panel[name] = floats(curve[kept])
            panel[f"{name}_residual"] = floats(measured[kept] - curve[kept])
    panel |= _finer(finer, len(time), most)
    return panel, len(time), len(kept)


def _finer(table: pa.Table | None, samples: int, most: int) -> dict[str, Any]:
    """The simulated curves between the measured times, where they are known there."""
    if table is None or table.num_rows <= samples:
        return {}
    time = _column(table, "time")
    found = {
        n: _column(table, c) for n, c in (("after", "simulated"), ("before", "simulated_before"))
    }
    found = {name: curve for name, curve in found.items() if np.isfinite(curve).any()}
    if not found:
        return {}
    kept = peaks(list(found.values()), most)
    more = {f"{name}_fine": floats(curve[kept]) for name, curve in found.items()}
    return {"t_fine": doubles(time[kept]), **more}


def _parts(table: pa.Table | None) -> dict[tuple[str, str], pa.Table]:
    """The rows of each output of each experiment, which stand behind each other in the table."""
    if table is None or not {"experiment", "output"} <= set(table.column_names):
        return {}
    encoded = [
        table[name].combine_chunks().dictionary_encode() for name in ("experiment", "output")
    ]
    codes = np.array([np.asarray(each.indices) for each in encoded])
    changes = np.flatnonzero((codes[:, 1:] != codes[:, :-1]).any(axis=0)) + 1
    found: dict[tuple[str, str], pa.Table] = {}
    for begin, end in pairwise([0, *changes.tolist(), table.num_rows]):
        key = tuple(str(each[begin].as_py()) for each in encoded)
        part = table.slice(begin, end - begin)
        known = found.get((key[0], key[1]))
        found[key[0], key[1]] = part if known is None else pa.concat_tables([known, part])
    return found


def _column(table: pa.Table, name: str) -> FloatArray:
    """A column with NaN for what is not there; runs of older versions have no curves before."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), np.float64)
