"""Gaps in a record: intervals much longer than its usual step without measurements of inputs.

Gaps are found from the times only. A model can be simulated through a gap if its inputs are known
there. An input is known if it is constant, or follows one straight line, before and after the gap,
for the length of the gap on each side. Any other input may have changed in the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from workers.messages import Experiment, FloatArray, Input, Output
from workers.messages.signals import even_step

LEAST_STEPS = 10
"""Least number of steps of a signal with a known usual step."""
STEPS_OF_GAP = 5.0
"""Least length of a gap in median steps; shorter intervals without samples are bridged."""
LONG_STEPS_OF_GAP, LONG_STEP = 4.0, 0.95
"""Least length of a gap in long steps, and the quantile of these. Of exponentially distributed
steps, which is a wide distribution, six in a million are longer."""
NEAR = 5
"""Number of steps on each side with which a gap is also compared, if the sampling rate changes."""
STRAIGHT = 1e-3
"""Negligible distance of an input from a straight line around a gap, over the input's range."""
NOISES, MOST_NOISE = 4.0, 0.02
"""This distance over the noise of an input, and its largest value over the input's range."""
WITH_OUTPUTS, UNEVEN, REPEATED = 0.5, 3.0, 0.1
"""An input has points at its changes, and not samples, if two conditions hold. It has points at
fewer than the first share of the outputs' times. The ratio of the 95 % to the 10 % quantile of its
steps exceeds the second value, or it is held and repeats fewer than the third share of values."""
NEAR_ROWS, USUAL_CHANGE = 200, 0.95
"""Number of rows on each side of a gap with which a signal's change across it is compared, and the
quantile of the changes between these rows that it may not exceed."""

LONG_UNITS = (("d", 86400.0), ("h", 3600.0))
"""Additional units for long gaps."""

Treatment = Literal["split", "left out", "bridged", "run through", "before"]


@dataclass(frozen=True)
class RecordGap:
    """A gap of a record, and its treatment.

    Attributes
    ----------
    record
        Id of the experiment.
    first, last
        The last time before the gap and the first time after it, in seconds.
    missing
        What was not measured, such as "input F"; "" if nothing was measured.
    treatment
        "split": the part after the gap is a separate experiment. "left out": this part is not used.
        "bridged": inputs are interpolated. "run through": inputs are known in the gap. "before":
        the record begins after the gap.
    moving
        The inputs that may have changed in the gap.
    why
        The reason for the treatment; may be "".
    row_step
        If nothing but the times shows the gap, the seconds between the other rows; otherwise 0. The
        clock may then have been set forward. See `even_row_step`.
    """

    record: str
    first: float
    last: float
    missing: str
    treatment: Treatment
    moving: tuple[str, ...] = ()
    why: str = ""
    row_step: float = 0.0

    @property
    def interval(self) -> str:
        """The length and the times of the gap as a text."""
        length = self.last - self.first
        long = next((f" ({length / s:.3g} {u})" for u, s in LONG_UNITS if length >= 2.0 * s), "")
        return f"{length:.6g} s{long}, from {self.first:.10g} to {self.last:.10g} s"


@dataclass(frozen=True)
class InputGap:
    """A gap in which one or more inputs were not measured.

    Attributes
    ----------
    first, last
        As in `RecordGap`.
    inputs
        The inputs without measurements.
    moving
        The inputs that may have changed in the gap.
    whole
        Whether nothing was measured in the gap.
    row_step
        As in `RecordGap`.
    """

    first: float
    last: float
    inputs: tuple[str, ...]
    moving: tuple[str, ...]
    whole: bool
    row_step: float = 0.0

    @property
    def missing(self) -> str:
        """What was not measured, as a text; "" if nothing was measured."""
        return "" if self.whole else named_signals("input", self.inputs)


def named_signals(kind: str, names: Sequence[str]) -> str:
    """Return a text such as "input F" or "inputs F and G"."""
    return f"{kind}{'s' if len(names) > 1 else ''} {' and '.join(names)}"


def long_steps(times: FloatArray) -> FloatArray:
    """Return the times before and after each gap between samples: (gaps, 2)."""
    steps = np.diff(times)
    if len(steps) < LEAST_STEPS:
        return np.zeros((0, 2))
    long = float(np.quantile(steps, LONG_STEP, method="lower"))
    least = max(STEPS_OF_GAP * float(np.median(steps)), LONG_STEPS_OF_GAP * long)
    found = [i for i in np.flatnonzero(steps > least).tolist() if _stands_out(steps, i)]
    return np.array([[times[i], times[i + 1]] for i in found]).reshape(-1, 2)


def _stands_out(steps: FloatArray, i: int) -> bool:
    """Return whether a step is much longer than the nearby steps on both sides."""
    sides = steps[max(i - NEAR, 0) : i], steps[i + 1 : i + 1 + NEAR]
    near = max(float(np.median(side)) if len(side) else 0.0 for side in sides)
    return float(steps[i]) > STEPS_OF_GAP * near


def input_gaps(experiment: Experiment, holds: Callable[[str], bool]) -> list[InputGap]:
    """Return the gaps of an experiment's inputs and signals; overlapping gaps are joined.

    Parameters
    ----------
    experiment
        The measured experiment.
    holds
        A function that returns whether an input with this name changes only at events.
    """
    found: list[tuple[float, float, str, bool]] = []
    for given in (*experiment.inputs, *experiment.signals):
        held = given.interpolation == "hold" or holds(given.variable)
        gaps = long_steps(given.times).tolist()
        if not gaps or _is_noted_at_changes(given, experiment, held=held):
            continue
        for first, last in gaps:
            if experiment.start <= first and last <= experiment.stop:
                goes_on = _goes_on(given, (first, last), held=held)
                found.append((first, last, given.variable, not goes_on))
    return [_joined(experiment, group) for group in _overlapping(sorted(found))]


def output_gaps(
    record: str,
    outputs: Sequence[Output],
    times: FloatArray,
    begin: float | None,
    stop: float | None,
) -> tuple[RecordGap, ...]:
    """Return the gaps of outputs, and the gap before the start of a record.

    Parameters
    ----------
    record
        Id of the experiment.
    outputs
        Outputs with all of their samples.
    times
        Times of the rows.
    begin
        Start of the record; None if the user gives it.
    stop
        End of the record, if the user gives it.
    """
    found: dict[tuple[float, float], list[str]] = {}
    for output in outputs:
        for first, last in long_steps(output.times).tolist():
            if stop is None or last <= stop:
                found.setdefault((first, last), []).append(output.variable)
    gaps = []
    for (first, last), names in sorted(found.items()):
        missing = named_signals("output", names)
        step = even_row_step(times, (first, last), outputs)
        gaps.append(RecordGap(record, first, last, missing, "run through", row_step=step))
    if begin is not None and begin > times[0]:
        gaps.insert(0, RecordGap(record, float(times[0]), begin, "", "before"))
    return tuple(gaps)


def _is_noted_at_changes(given: Input, experiment: Experiment, *, held: bool) -> bool:
    """Return whether an input has points only at its changes; see `WITH_OUTPUTS`."""
    if len(given.times) <= LEAST_STEPS:
        return True
    measured = np.concatenate([np.zeros(0), *(output.times for output in experiment.outputs)])
    if len(measured) and np.mean(np.isin(measured, given.times)) >= WITH_OUTPUTS:
        return False
    short, long = np.quantile(np.diff(given.times), [0.1, LONG_STEP], method="lower").tolist()
    repeats = float(np.mean(np.diff(given.values) == 0.0))
    return bool(long > UNEVEN * short) or (held and repeats < REPEATED)


def _goes_on(given: Input, gap: tuple[float, float], *, held: bool) -> bool:
    """Return whether an input follows one straight line before and after a gap."""
    extent = float(np.ptp(given.values))
    if extent == 0.0:
        return True
    first, last = gap
    length = last - first
    near = (given.times >= first - length) & (given.times <= last + length)
    times, values = given.times[near], given.values[near]
    if times[0] > first - 0.5 * length or times[-1] < last + 0.5 * length:
        return False
    noise = NOISES * _noise(given.values)
    tolerance = max(STRAIGHT * extent, min(noise, MOST_NOISE * extent))
    if held:
        return bool(0.5 * np.ptp(values) <= tolerance)
    x = (times - first) / length
    line = np.polynomial.Polynomial.fit(x, values, 1)
    return bool(np.max(np.abs(values - line(x))) <= tolerance)


def _noise(values: FloatArray) -> float:
    """Return the noise of an input from its second differences."""
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6.0))


def _overlapping(
    found: Sequence[tuple[float, float, str, bool]],
) -> Iterator[list[tuple[float, float, str, bool]]]:
    """Yield groups of overlapping gaps."""
    group: list[tuple[float, float, str, bool]] = []
    for each in found:
        if group and each[0] >= max(last for _, last, *_ in group):
            yield group
            group = []
        group.append(each)
    if group:
        yield group


def _joined(experiment: Experiment, group: Sequence[tuple[float, float, str, bool]]) -> InputGap:
    first, last = min(each[0] for each in group), max(each[1] for each in group)
    driving = (*experiment.inputs, *experiment.signals)
    times = [given.times for given in driving] + [o.times for o in experiment.outputs]
    inside = [bool(np.any((own > first) & (own < last))) for own in times]
    names = tuple(dict.fromkeys(each[2] for each in group))
    moving = tuple(dict.fromkeys(each[2] for each in group if each[3]))
    rows = np.unique(np.concatenate(times))
    step = even_row_step(rows, (first, last), (*driving, *experiment.outputs))
    return InputGap(first, last, names, moving, not any(inside), step)


def even_row_step(
    rows: FloatArray, gap: tuple[float, float], signals: Sequence[Input | Output]
) -> float:
    """Return the seconds between rows if a clock may have been set forward; 0 if not.

    The gap must lie between two rows, the other rows must be evenly spaced, and no signal may
    change more across the gap than between other rows.

    Parameters
    ----------
    rows
        Times of the rows.
    gap
        The times before and after the gap.
    signals
        The measured signals.
    """
    first, last = gap
    if np.any((rows > first) & (rows < last)):
        return 0.0
    for each in signals:
        i = int(np.searchsorted(each.times, first))
        near = np.abs(np.diff(each.values[max(i - NEAR_ROWS, 0) : i + NEAR_ROWS]))
        if each.times[i : i + 2].tolist() != [first, last] or len(near) < LEAST_STEPS:
            return 0.0
        if near[min(i, NEAR_ROWS)] > np.quantile(near, USUAL_CHANGE, method="lower"):
            return 0.0
    return even_step(np.diff(rows))


MOST_NAMED_GAPS, MOST_FINDINGS = 4, 12
"""Largest number of gaps that a sentence names, and largest number of sentences."""
EFFECTS: Mapping[Treatment, tuple[str, str]] = {
    "split": (
        " may have changed there, so a new part begins after the gap; its initial states are "
        "estimated",
        'to interpolate the inputs instead, set gaps = "bridge" in the experiment',
    ),
    "left out": (" may have changed there, so the part after the gap is left out", ""),
    "bridged": (
        " may have changed there; the gap is bridged by a straight line, or by the last value "
        "before the gap",
        'to start a new part after the gap, set gaps = "split" in the experiment',
    ),
    "before": ("the record begins after the gap", ""),
    "run through": ("the inputs are known in the gap, and the simulation continues through it", ""),
}
"""For each treatment, its effect and how to change it."""


def gap_findings(gaps: Sequence[RecordGap]) -> list[tuple[str, str, Treatment]]:
    """Return a sentence, an advice and the treatment for the gaps of each record."""
    groups: dict[tuple[object, ...], list[RecordGap]] = {}
    for gap in gaps:
        same = gap.record, gap.treatment, gap.missing, gap.moving, gap.why, gap.row_step
        groups.setdefault(same, []).append(gap)
    alike = list(groups.values())
    found = [(_sentence(own), _advice(own[0]), own[0].treatment) for own in alike[:MOST_FINDINGS]]
    rest = [gap for own in alike[MOST_FINDINGS:] for gap in own]
    if rest:
        records = len({gap.record for gap in rest})
        said = f"{len(rest)} more gaps in {records} experiment{'s' if records > 1 else ''}"
        cut = [gap.treatment for gap in rest if gap.treatment != "run through"]
        found.append((said, "", cut[0] if cut else "run through"))
    return found


def _advice(gap: RecordGap) -> str:
    """Return how to change the treatment, and another possible reason for the gap."""
    advice = EFFECTS[gap.treatment][1]
    if not gap.row_step:
        return advice
    clock = (
        "if no row is missing in the gap, the clock was set forward (the other rows are "
        f"{gap.row_step:.6g} s apart, and no signal jumps); in this case, give sample_time = "
        f"{gap.row_step:.6g}, the seconds between rows, instead of time"
    )
    return f"{clock}; {advice}" if advice else clock


def _sentence(alike: Sequence[RecordGap]) -> str:
    """Return a sentence on the gaps of a record with the same treatment."""
    gap, count = alike[0], len(alike)
    named = [each.interval for each in alike[:MOST_NAMED_GAPS]]
    more = f" and {count - MOST_NAMED_GAPS} more" if count > MOST_NAMED_GAPS else ""
    what = f"no data for {gap.missing}" if gap.missing else "no data at all"
    has = "a gap of" if count == 1 else f"{count} gaps:"
    who = named_signals("input", gap.moving) if gap.moving else ""
    because = f" ({gap.why})" if gap.why else ""
    return (
        f"experiment {gap.record} has {has} {'; '.join(named)}{more}, with {what}: "
        f"{who}{EFFECTS[gap.treatment][0]}{because}"
    )
