"""Records: the rows of a stacked residual vector that belong to one measured signal.

A stacked vector contains the experiments one after the other, in each experiment the outputs, and
for each output the samples in the order of time. A *record* is the part of one output. Neighbouring
rows within a record are neighbours in time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from workers.messages import Experiment, FloatArray, IntArray


@dataclass(frozen=True)
class OutputRecord:
    """One output of one experiment.

    Attributes
    ----------
    experiment
        Index of the experiment.
    output
        Index in `StackedRecords.outputs`.
    rows
        Rows of the samples in a stacked vector.
    times
        Time of each row in seconds.
    """

    experiment: int
    output: int
    rows: slice
    times: FloatArray = field(repr=False)


@dataclass(frozen=True)
class StackedRecords:
    """All records of a stacked vector, in its order and without gaps.

    Attributes
    ----------
    outputs
        Names of the measured variables, each once, in the order of first appearance.
    items
        The records.
    """

    outputs: tuple[str, ...]
    items: tuple[OutputRecord, ...]

    @cached_property
    def size(self) -> int:
        """Length of the stacked vector."""
        return sum(len(record.times) for record in self.items)

    def of_output(self, output: int) -> IntArray:
        """Return the rows of one output in all experiments, in ascending order."""
        return _rows(record for record in self.items if record.output == output)

    def by_output(self, stacked: FloatArray) -> list[FloatArray]:
        """Return the part of each output in a stacked vector."""
        return [stacked[self.of_output(output)] for output in range(len(self.outputs))]

    def of_experiment(self, experiment: int) -> IntArray:
        """Return the rows of all outputs of one experiment, in ascending order."""
        return _rows(record for record in self.items if record.experiment == experiment)


def make_records(experiments: Sequence[Experiment]) -> StackedRecords:
    """Return the records of the residuals of these experiments, stacked in this order."""
    names = dict.fromkeys(output.variable for each in experiments for output in each.outputs)
    outputs = tuple(names)
    signals = [
        (e, outputs.index(output.variable), output.times)
        for e, experiment in enumerate(experiments)
        for output in experiment.outputs
    ]
    return StackedRecords(outputs, _stacked(signals))


def thinned(records: StackedRecords, most: int) -> tuple[StackedRecords, IntArray]:
    """Keep every s-th sample of each record, with the least s that gives at most `most` rows.

    Use it to screen long data: tests then use the kept samples without smoothing. Every record
    keeps its first sample, so with many records there may be more than `most` rows.

    Returns
    -------
    records
        Records of the kept rows.
    rows : (kept,)
        Ascending indices in the full vector: `residuals[rows]` belongs to the new records.
    """
    lengths = np.array([len(record.times) for record in records.items], dtype=int)
    longest = int(lengths.max(initial=1))
    stride = max(1, -(-records.size // max(most, 1)))
    while stride < longest and int((-(-lengths // stride)).sum()) > most:
        stride += 1
    stride = min(stride, longest)
    signals = [(item.experiment, item.output, item.times[::stride]) for item in records.items]
    rows = _rows(records.items, stride)
    return StackedRecords(records.outputs, _stacked(signals)), rows


def _stacked(signals: Iterable[tuple[int, int, FloatArray]]) -> tuple[OutputRecord, ...]:
    """Return consecutive records for (experiment, output, times)."""
    items: list[OutputRecord] = []
    start = 0
    for experiment, output, times in signals:
        items.append(OutputRecord(experiment, output, slice(start, start + len(times)), times))
        start += len(times)
    return tuple(items)


def _rows(records: Iterable[OutputRecord], stride: int = 1) -> IntArray:
    rows = [np.arange(item.rows.start, item.rows.stop, stride) for item in records]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=int)
