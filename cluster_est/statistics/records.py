"""Records: the rows of the stacked residual vector that are one measured signal.

A residual vector is stacked: experiment after experiment, in it output after output, in that the
samples in the order of time. A *record* is one such run of samples; neighbours in it are neighbours
in time, across its ends they are not.
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
        Index into the experiments that the records were made from.
    output
        Index into `Records.outputs`.
    rows
        Of its samples in a stacked vector.
    times
        Seconds, one for each row.
    """

    experiment: int
    output: int
    rows: slice
    times: FloatArray = field(repr=False)


@dataclass(frozen=True)
class StackedRecords:
    """All records of a stacked vector, in its order, without gaps.

    Attributes
    ----------
    outputs
        Names of the measured variables, each once, in the order of their first appearance.
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
        """Rows of one output in all experiments, ascending."""
        return _rows(record for record in self.items if record.output == output)

    def by_output(self, stacked: FloatArray) -> list[FloatArray]:
        """The part of each output of a stacked vector."""
        return [stacked[self.of_output(output)] for output in range(len(self.outputs))]

    def of_experiment(self, experiment: int) -> IntArray:
        """Rows of all outputs of one experiment, ascending."""
        return _rows(record for record in self.items if record.experiment == experiment)


def make_records(experiments: Sequence[Experiment]) -> StackedRecords:
    """Records of the residuals of these experiments, stacked in this order."""
    names = dict.fromkeys(output.variable for each in experiments for output in each.outputs)
    outputs = tuple(names)
    signals = [
        (e, outputs.index(output.variable), output.times)
        for e, experiment in enumerate(experiments)
        for output in experiment.outputs
    ]
    return StackedRecords(outputs, _stacked(signals))


def thinned(records: StackedRecords, most: int) -> tuple[StackedRecords, IntArray]:
    """Every s-th sample of each record, s as small as `most` rows in all allow.

    For screening long data: what is tested afterwards are the samples that were kept, so nothing
    is smoothed or aliased that was not in the data before. Every record keeps its first sample,
    hence there may be more than `most` rows where there are more records than that.

    Returns
    -------
    records
        Of the rows that were kept.
    rows : (kept,)
        Their indices in the full vector, ascending: `residuals[rows]` belongs to the new records.
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
    """Records of (experiment, output, times), one after the other."""
    items: list[OutputRecord] = []
    start = 0
    for experiment, output, times in signals:
        items.append(OutputRecord(experiment, output, slice(start, start + len(times)), times))
        start += len(times)
    return tuple(items)


def _rows(records: Iterable[OutputRecord], stride: int = 1) -> IntArray:
    rows = [np.arange(item.rows.start, item.rows.stop, stride) for item in records]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=int)
