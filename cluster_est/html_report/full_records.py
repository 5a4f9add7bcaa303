"""All samples of a record, packed into the page for zooming.

A chart shows at most two samples of a curve in each column. When a reader has zoomed in, the page's
script draws these samples instead.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from workers.messages import FloatArray

MOST_BYTES = 800_000
"""Number of characters of all records of a page together; the largest errors come first."""
UNEVEN = 1e-3
"""Largest deviation of samples from even spacing, in steps, that is ignored."""


class Samples(Protocol):
    """Measured and simulated values at the same times; see `OutputCurves`."""

    @property
    def time(self) -> FloatArray: ...
    @property
    def measured(self) -> FloatArray: ...
    @property
    def after(self) -> FloatArray: ...
    @property
    def before(self) -> FloatArray: ...


@dataclass(frozen=True)
class FullRecord:
    """A record in single precision, as base64.

    Attributes
    ----------
    id
        Name of the record on the page.
    begin
        First time, in the unit of the chart.
    step
        Step between samples; 0 if they are not evenly spaced, and then the first curve contains the
        steps.
    curves
        Names of the curves, whose samples are concatenated.
    text
        All samples, little-endian.
    """

    id: str
    begin: float
    step: float
    curves: tuple[str, ...]
    text: str = field(repr=False)


def full_records(records: Mapping[str, Samples], order: Iterable[str]) -> dict[str, FullRecord]:
    """Pack the records that fit into `MOST_BYTES`.

    Parameters
    ----------
    records
        Records by their names on the page, with times in the unit of their charts.
    order
        Names of the records to pack, the most important first.
    """
    found: dict[str, FullRecord] = {}
    room = MOST_BYTES
    for name in order:
        packed = _packed(name, records[name])
        if len(packed.text) <= room:
            room -= len(packed.text)
            found[name] = packed
    return found


def _packed(name: str, record: Samples) -> FullRecord:
    time = record.time
    steps = np.diff(time)
    step = float(time[-1] - time[0]) / len(steps)
    curves = {"measured": record.measured, "before": record.before, "after": record.after}
    kept = {each: values for each, values in curves.items() if np.isfinite(values).any()}
    if np.abs(time - np.linspace(time[0], time[-1], len(time))).max() > UNEVEN * step:
        step, kept = 0.0, {"step": np.append(0.0, steps), **kept}
    joined = np.concatenate([values.astype("<f4") for values in kept.values()])
    text = base64.b64encode(joined.tobytes()).decode()
    return FullRecord(name, float(time[0]), step, tuple(kept), text)
