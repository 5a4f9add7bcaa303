"""A picture of a case as SVG: a held-out record, measured and simulated, and the errors below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from docs.svg import RECORD_STYLE, Axes, document, legend, record, text

from workers.messages import FloatArray

LEFT, RIGHT = 80, 840
MOST_SAMPLES = 400
"""Of a long record the samples around the largest error of the base model are drawn."""
CURVES = {"base": "base model", "loop": "closed loop", "textbook": "textbook"}
KINDS = {"base": "thin c1", "loop": "thin c0", "textbook": "thin dashed c2"}


@dataclass(frozen=True)
class Record:
    """A stretch of one output of one experiment: (n,) times, measured, and simulated by name."""

    experiment: str
    output: str
    times: FloatArray
    measured: FloatArray
    simulated: Mapping[str, FloatArray]


def held_out_record(runs: Mapping[str, Path]) -> Record:
    """Read what is drawn: the held-out output that the base model misses most.

    Parameters
    ----------
    runs
        Run folders by the names of `CURVES`, "base" among them.
    """
    rows = pq.read_table(runs["base"] / "errors.parquet").to_pylist()
    worst = max(
        (row for row in rows if row["role"] == "test"),
        key=lambda row: row["samples"] * row["rmse_after"] ** 2,
    )
    at = (worst["experiment"], worst["output"])
    times, measured, _ = _columns(runs["base"], *at)
    simulated = {name: _columns(folder, *at)[2] for name, folder in runs.items()}
    part = stretch(np.abs(measured - simulated["base"]))
    cut = {name: values[part] for name, values in simulated.items()}
    return Record(*at, times[part], measured[part], cut)


def _columns(run: Path, experiment: str, output: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(times, measured, simulated) of an output of an experiment."""
    filters = [("experiment", "=", experiment), ("output", "=", output)]
    table = pq.read_table(run / "residuals.parquet", filters=filters)
    times, measured, simulated = (
        table[name].to_numpy() for name in ("time", "measured", "simulated")
    )
    return times, measured, simulated


def stretch(errors: FloatArray) -> slice:
    """Where the largest error is, with half of `MOST_SAMPLES` on each side as far as there are."""
    middle, half = int(np.argmax(errors)), MOST_SAMPLES // 2
    first = max(0, min(middle - half, len(errors) - MOST_SAMPLES))
    return slice(first, first + MOST_SAMPLES)


def round_values(low: float, high: float) -> list[float]:
    """Two to five multiples of 1, 2 or 5 times a power of ten between two numbers."""
    step = 10.0 ** math.floor(math.log10((high - low) / 2.0))
    step *= max(each for each in (1.0, 2.0, 5.0) if each * step <= (high - low) / 2.0)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [step * i for i in range(first, last + 1)]


def picture(shown: Record, title: str, unit: str) -> str:
    """Draw a record.

    Parameters
    ----------
    shown
        What is drawn.
    title
        What was measured.
    unit
        Of the output.

    Returns
    -------
    str
        A whole SVG file, with colours for a light and for a dark page.
    """
    times, unit = shown.times, _escaped(unit)
    curves = {KINDS[name]: shown.simulated[name] for name in CURVES if name in shown.simulated}
    names = {KINDS[name]: words for name, words in CURVES.items() if name in shown.simulated}
    upper = _axes(70, 270, times, [shown.measured, *curves.values()])
    lower = _axes(320, 420, times, [shown.measured - each for each in curves.values()])
    head = f"{_escaped(shown.output)} in {unit}, held out: {_escaped(shown.experiment)}"
    parts = [
        text(LEFT, 24, head, "plain"),
        *legend(LEFT, 50, names, 150),
        *upper.rules(round_values(*upper.y), "{:.6g}".format),
        text(LEFT, 304, f"measured - simulated in {unit}", "plain"),
        *lower.rules(round_values(*lower.y), "{:.6g}".format),
        *record(upper, lower, times, shown.measured, curves),
        text(LEFT, 446, f"{times[0]:.6g} s"),
        text(RIGHT, 446, f"{times[-1]:.6g} s", anchor="end"),
    ]
    return document((860, 460), _escaped(title), RECORD_STYLE, parts)


def _axes(top: float, bottom: float, times: FloatArray, curves: Sequence[FloatArray]) -> Axes:
    low, high = min(c.min() for c in curves), max(c.max() for c in curves)
    spare = 0.05 * (high - low) or 1.0
    span = (float(times[0]), float(times[-1]))
    return Axes(LEFT, RIGHT, top, bottom, span, (float(low - spare), float(high + spare)))


def _escaped(words: str) -> str:
    return words.replace("&", "&amp;").replace("<", "&lt;")
