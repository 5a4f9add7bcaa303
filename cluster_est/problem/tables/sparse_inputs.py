"""Finds inputs with much fewer samples than other signals: slow sensors, and records of changes.

Loggers, databases and buses often record a signal only when it changes. Such a signal keeps each
value until its next sample, and straight lines between its samples are wrong. A temperature that
was measured every ten minutes has few samples too, but lines are right. The samples show the
difference only in part (`recorded_at_changes`), and a fit tests both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.problem.tables.jumps import (
    FEW_SAMPLES,
    MOST_NAMED_RECORDS,
    interpolated,
    of_column,
    recorded_at_changes,
    regular,
)
from workers.messages import Experiment, FloatArray, Input, Output

SPARSE = 3.0
"""Least number of samples of another signal, over those of an input with few samples."""


@dataclass(frozen=True)
class FewSamples:
    """An input with few samples in one experiment.

    Attributes
    ----------
    experiment, variable
        Id of the experiment, and the input.
    samples, others
        Number of samples of the input, and the largest number of samples of another signal.
    other
        This signal.
    regular
        Whether the samples are regular.
    at_changes
        Whether the input seems to be recorded only when it changes.
    known
        Whether the samples are enough to show this.
    """

    experiment: str
    variable: str
    samples: int
    others: int
    other: str
    regular: bool
    at_changes: bool
    known: bool


def is_sparse(samples: int, others: int) -> bool:
    """Return whether a signal has much fewer samples than another one, but more than one."""
    return samples > 1 and SPARSE * samples <= others


def few_samples(run: Experiment, given: Input) -> FewSamples | None:
    """Return what is known of an input with few samples; None if it has as many as other signals.

    A signal that stops early has a short step, and does not count.
    """
    values = given.values[_inside(run, given.times)]
    times = given.times[_inside(run, given.times)]
    signals: list[Input | Output] = [*run.outputs]
    signals += (each for each in run.inputs if each is not given)
    counts = [int(np.sum(_inside(run, each.times))) for each in signals]
    if not counts or not is_sparse(len(times), max(counts)) or not np.ptp(values):
        return None
    most = signals[int(np.argmax(counts))]
    even = regular(times)
    usual = np.median(np.diff(most.times[_inside(run, most.times)]))
    if even and np.median(np.diff(times)) < SPARSE * usual:
        return None
    return FewSamples(
        run.id, given.variable, len(times), max(counts), most.variable, even,
        recorded_at_changes(times, values), len(times) >= FEW_SAMPLES,
    )  # fmt: skip


def _inside(run: Experiment, times: FloatArray) -> npt.NDArray[np.bool_]:
    return (times >= run.start) & (times <= run.stop)


@dataclass(frozen=True)
class SparseInput:
    """A linearly interpolated input with few samples, in all experiments where it has them."""

    records: tuple[FewSamples, ...]

    @property
    def variable(self) -> str:
        """The input."""
        return self.records[0].variable

    @property
    def at_changes(self) -> bool:
        """Whether it seems to be recorded only when it changes."""
        return any(each.at_changes for each in self.records)

    @property
    def slow(self) -> bool:
        """Whether its samples look like those of a slow sensor."""
        return not self.at_changes and any(each.known for each in self.records)

    def finding(self, columns: Mapping[str, str]) -> tuple[str, str]:
        """Return a finding and an advice; `columns` are known columns by config key."""
        said = f"input {self.variable}{of_column(self.variable, columns)} has {self._where}"
        if self.at_changes:
            said += (
                "; its times are irregular and its value jumps from sample to sample, as if it "
                "were recorded only when it changes; linear interpolation turns jumps into ramps"
            )
        else:
            said += "; it is interpolated linearly between them"
        key = interpolated(self.variable, columns, "hold")
        return said, (
            f"{key}, if the input keeps each sample until the next, for example because it is "
            "recorded only when it changes"
        )

    @property
    def _where(self) -> str:
        most, *_ = named = self.records[:MOST_NAMED_RECORDS]
        texts = [
            f"{most.samples} samples in {most.experiment}, where {most.other} has {most.others}"
        ]
        texts += [f"{each.samples} of {each.others} in {each.experiment}" for each in named[1:]]
        more = len(self.records) - len(named)
        return ", ".join(texts) + (f", and few in {more} more experiments" if more > 0 else "")


def sparse_inputs(
    experiments: Sequence[Experiment], holds: Callable[[str], bool]
) -> tuple[SparseInput, ...]:
    """Return the inputs with few samples that are interpolated linearly.

    Parameters
    ----------
    experiments
        The experiments of a problem.
    holds
        A function that returns whether an input with this name is always held, because the FMU
        declares that it changes only at events.
    """
    found: dict[str, list[FewSamples]] = {}
    for run in experiments:
        for given in run.inputs:
            if given.interpolation == "linear" and not holds(given.variable):
                few = few_samples(run, given)
                if few is not None:
                    found.setdefault(given.variable, []).append(few)
    return tuple(SparseInput(tuple(records)) for records in found.values())
