"""A fit of an FMU back to values that were planted in a curve which fmpy has computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import tomli_w

from cluster_est.drafting.candidates import candidates
from cluster_est.methods.method import Ending
from cluster_est.run_folder.reading import read_facts
from fmu_trials.commands import CommandEnd, run_command
from fmu_trials.curve import Array, Trial, referred

CHANGE = 1.1
"""Planted over the FMU's own value."""
MOST_TRIED, MOST_OUTPUTS = 6, 5
VISIBLE = 1e-4
"""Of an output's size: what a planted value must change."""
BUDGET = 0.4
"""Share of its time after which a fit is to end by itself: one that does not is no slow one."""
RETURNED = 1e-3
"""Relative distance from the planted value of a fit that has returned to it."""


def fit_back(given: Trial, folder: Path, seconds: float) -> dict[str, str]:
    """Plant a value, and fit from the FMU's own with each executor: what came of it, in words."""
    executors = ("local", "processes")
    plain = referred(given, seconds)
    if isinstance(plain, str):
        return dict.fromkeys(executors, f"not tried: fmpy says: {plain}")
    likely = [c for c in candidates(given.description) if c.start != 0.0 and c.variable.size == 1]
    for candidate in likely[:MOST_TRIED]:
        name, value = candidate.variable.name, CHANGE * candidate.start
        curve = referred(given, seconds, {name: value})
        if isinstance(curve, str) or not np.isfinite(curve).all():
            continue
        columns = _visible(plain, curve)
        if columns:
            config = _write(given, folder, curve, columns, name, candidate.start)
            return {each: _fit(config, each, name, value, seconds) for each in executors}
    return dict.fromkeys(executors, "not tried: no parameter moves an output")


def _visible(plain: Array, curve: Array) -> list[int]:
    """Return the outputs that a planted value moves."""
    sizes = np.maximum(np.abs(plain).max(axis=0), 1e-12)
    moved = np.abs(curve - plain).max(axis=0) / sizes
    return [int(i) for i in np.flatnonzero(moved > VISIBLE)[:MOST_OUTPUTS]]


def _write(
    given: Trial, folder: Path, curve: Array, columns: list[int], name: str, start: float
) -> Path:
    """Write data and a config."""
    times = given.times
    table = {"time": times} | {f"y{i}": curve[:, i] for i in columns}
    pacsv.write_csv(pa.table(table), folder / "data.csv")
    exchange = given.interface == "model_exchange"
    model = {"fmu": str(given.file.resolve()), "interface": given.interface}
    config = {
        "model": model | ({"rtol": 1e-8} if exchange else {}),
        "parameters": {name: {"start": start, "bounds": sorted((0.5 * start, 2.0 * start))}},
        "experiments": [
            {
                "id": "a",
                "data": "data.csv",
                "time": "time",
                "outputs": {given.outputs[i]: f"y{i}" for i in columns},
            }
        ],
    }
    path = folder / "config.toml"
    path.write_text(tomli_w.dumps(config), encoding="utf-8")
    return path


def _fit(config: Path, executor: str, name: str, planted: float, seconds: float) -> str:
    out = config.parent / executor
    arguments = ["fit", str(config), "--out", str(out), "--no-report", f"executor.name={executor}"]
    arguments.append(f"budget.seconds={BUDGET * seconds}")
    ended = run_command(arguments, config.parent, seconds)
    if ended.fault:
        return f"{ended.fault}: {ended.last_sentence}"
    found = _estimate(out, name)
    if found is None:
        return _no_estimate(ended)
    far = abs(found / planted - 1.0)
    late = read_facts(out).get("ending") == Ending.BUDGET.name.lower()
    what = "returned" if far <= RETURNED else "out of time" if late else "elsewhere"
    return f"{what}: {name} {far:.1e} from the truth"


def _estimate(out: Path, name: str) -> float | None:
    path = out / "parameters.parquet"
    rows = pq.read_table(path).to_pylist() if path.exists() else []
    return next((float(row["value"]) for row in rows if row["parameter"] == name), None)


def _no_estimate(ended: CommandEnd) -> str:
    return f"refused: {ended.last_sentence or ended.code}"
