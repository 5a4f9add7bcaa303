"""Every sample of a record, packed into the page for whoever zooms in.

A chart shows at most two samples of a curve for each of its columns. The page's script draws what
is here instead, once a reader has zoomed in.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from workers.messages import FloatArray

MOST_BYTES = 800_000
"""Characters that all records of a page take together; those with the largest errors come first."""
UNEVEN = 1e-3
"""Steps by which samples may be off their even places without being drawn elsewhere."""


class Samples(Protocol):
    """What was measured and simulated at the same times; see `OutputCurves`."""

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
        Its name on the page.
    begin
        First time, in the unit of the chart.
    step
        Between samples; 0 where they are not evenly spaced: then the steps are the first curve.
    curves
        Names of the curves, whose samples stand behind each other.
    text
        All of them, little-endian.
    """

    id: str
    begin: float
    step: float
    curves: tuple[str, ...]
    text: str = field(repr=False)


def full_records(records: Mapping[str, Samples], order: Iterable[str]) -> dict[str, FullRecord]:
    """Pack records until the page holds `MOST_BYTES` of them.

    Parameters
    ----------
    records
        By the name that each has on the page, with times in the unit of its chart.
    order
        Names of those to pack, the one that a reader wants first at the beginning.
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
