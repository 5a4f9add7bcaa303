"""Measured, before, after and residual curves of every experiment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.report.blocks import Explorer, Section, Text, with_unit
from cluster_est.report.decimate import peaks
from cluster_est.report.encode import doubles, floats
from cluster_est.report.folder import Run
from cluster_est.report.numbers import count
from workers.messages import FloatArray

MOST_POINTS = 80_000
"""Of all curves together: about 32 bytes each in the page."""
FEWEST, MOST = 400, 20_000
"""Points of one output of one experiment."""


def curves(run: Run) -> Section:
    """All experiments, of which the page shows one."""
    table = run.residuals
    if table is None or not table.num_rows:
        return Section("curves", "Curves", ())
    keys = table.group_by(["experiment", "output"], use_threads=False).aggregate([("role", "min")])
    pairs = list(zip(*(keys[name].to_pylist() for name in ("experiment", "output")), strict=True))
    roles = keys["role_min"].to_pylist()
    units = {row["output"]: row["unit"] for row in run.tables["errors"]}
    most = int(np.clip(MOST_POINTS / max(1, len(pairs)), FEWEST, MOST))
    found: dict[str, dict[str, Any]] = {}
    samples, drawn = 0, 0
    for (experiment, output), role in zip(pairs, roles, strict=True):
        panel, size, kept = _panel(run, experiment, output, units.get(output, ""), most)
        if panel is None:
            continue
        entry = found.setdefault(experiment, {"id": experiment, "role": role, "outputs": []})
        entry["outputs"].append(panel)
        samples, drawn = samples + size, drawn + kept
    if not found:
        return Section("curves", "Curves", ())
    how = (
        "Every sample is drawn."
        if samples == drawn
        else f"Of {count(samples)} samples {count(drawn)} are drawn: the lowest and the highest of "
        "each curve in each short stretch, so that no peak is lost."
    )
    text = Text(f"Before: {run.before}. Drag to zoom, double-click to see all. {how}")
    return Section("curves", "Measured and simulated", (text, Explorer(tuple(found.values()))))


def _panel(
    run: Run, experiment: str, output: str, unit: str, most: int
) -> tuple[dict[str, Any] | None, int, int]:
    """One output of one experiment, with how many samples it has and how many are drawn."""
    table = _rows(run.residuals, experiment, output)
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
    panel |= _finer(run, experiment, output, len(time), most)
    return panel, len(time), len(kept)


def _finer(run: Run, experiment: str, output: str, samples: int, most: int) -> dict[str, Any]:
    """The simulated curves between the measured times, where they are known there."""
    if run.trajectories is None or "output" not in run.trajectories.column_names:
        return {}
    table = _rows(run.trajectories, experiment, output)
    if table.num_rows <= samples:
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


def _rows(table: pa.Table, experiment: str, output: str) -> pa.Table:
    wanted = pc.and_(pc.equal(table["experiment"], experiment), pc.equal(table["output"], output))
    return table.filter(wanted)


def _column(table: pa.Table, name: str) -> FloatArray:
    """A column with NaN for what is not there; runs of older versions have no curves before."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(pc.cast(table[name], pa.float64()).to_numpy(), np.float64)
