"""Signals that jump: a switch, a set point, the output of a controller.

Between jumps they keep their value, or move in small steps.

Between two samples a straight line makes a ramp of such a jump, which begins up to a sampling
interval too early. A fit calls that a delay or a lag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.statistics.noise.outliers import isolated_outliers
from cluster_est.toml import dotted, inline
from workers.messages import Experiment, FloatArray, Input, Interpolation

LEAST_SAMPLES_WITH_JUMPS = 10
LEAST_REPEATED_SHARE = 0.5
"""Least share of the samples that repeat the one before."""
LEAST_ISOLATED_SHARE = 0.8
"""Least share of the changes that stand alone, with samples that repeat before and after."""
LEAST_JUMP = 0.05
"""Least median change, over the range of the signal: smaller ones are the steps of a converter."""
NEAR_STEPS = 3
"""Steps to either side that a jump of a moving signal is compared with."""
OVER_NEAR_STEPS = 6.0
"""Least size of such a jump, in the largest of those."""
USUAL_STEPS, OVER_USUAL_STEPS = 0.75, 5.0
"""A quantile of the sizes of all steps, and the least size of such a jump in it."""
LEAST_JUMPS_WHILE_MOVING = 2
"""A single one may be anything."""
SAMPLES_AFTER_JUMP = 3
"""Samples from the jump of an input on, in which what is fast answers."""
LEAST_NOISE_OF_RANGE = 0.01
"""Share of a signal's range that its noise counts as at least where single samples are looked for
that stand apart."""
REGULAR = 0.1
"""Largest range of the times between changes, over their median, of a staircase."""


def count_jumps(times: FloatArray, values: FloatArray) -> int:
    """Return the number of jumps of a signal; 0 for one that has none.

    A ramp that a table gives two points of its own, closer than its other samples, is no jump.

    Parameters
    ----------
    times, values : (n,)
        Of its samples, in order.
    """
    return len(_jumps(times, values))


def _jumps(times: FloatArray, values: FloatArray) -> npt.NDArray[np.int64]:
    """Return the intervals between samples in which a signal jumps."""
    if len(values) < LEAST_SAMPLES_WITH_JUMPS or not np.isfinite(values).all():
        return np.zeros(0, np.int64)
    intervals = np.diff(times)
    wide = intervals >= 0.5 * float(np.median(intervals))
    found = _between_levels(values, wide)
    return found if len(found) else _while_moving(values, wide)


def _between_levels(values: FloatArray, wide: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the jumps of a signal that keeps its value between them."""
    size, changes = np.abs(np.diff(values)), _changes(values)
    none = np.zeros(0, np.int64)
    if not changes.any() or np.mean(~changes) < LEAST_REPEATED_SHARE:
        return none
    around = np.concatenate([[False], changes, [False]])
    alone = changes & wide & ~around[:-2] & ~around[2:]
    binary = len(np.unique(values)) == 2 and bool(np.all(wide[changes]))
    small = float(np.median(size[changes])) < LEAST_JUMP * float(np.ptp(values))
    if (
        small
        or _is_rounded(values, changes)
        or not (binary or np.sum(alone) >= LEAST_ISOLATED_SHARE * np.sum(changes))
    ):
        return none
    return np.flatnonzero(changes)


def _while_moving(values: FloatArray, wide: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the jumps of a signal that moves in small steps between them.

    Each is large beside all steps near it, to both sides, and beside most steps of the signal: the
    one of a spike has another beside it, and those of noise are as large as their neighbours.
    """
    steps = np.abs(np.diff(values))
    extended = np.pad(steps, NEAR_STEPS, constant_values=0.0)
    near = np.zeros(len(steps))
    for shift in range(2 * NEAR_STEPS + 1):
        if shift != NEAR_STEPS:
            np.maximum(near, extended[shift : shift + len(steps)], out=near)
    usual = float(np.quantile(steps, USUAL_STEPS))
    large = (steps > OVER_NEAR_STEPS * near) & (steps > OVER_USUAL_STEPS * usual)
    large &= wide & (steps > LEAST_JUMP * float(np.ptp(values)))
    large[:NEAR_STEPS] = large[-NEAR_STEPS:] = False
    found = np.flatnonzero(large)
    moves = usual > 1e-9 * float(np.ptp(values))  # else it has levels, and was looked at before
    return found if moves and len(found) >= LEAST_JUMPS_WHILE_MOVING else found[:0]


def jump_times(given: Input) -> FloatArray:
    """Return when an input that jumps begins to do so; none for others."""
    jumps = _jumps(given.times, given.values)
    return given.times[jumps if given.interpolation == "linear" else jumps + 1]


def after_jumps(experiment: Experiment, output: str) -> npt.NDArray[np.bool_]:
    """Return which samples of an output are just after a jump of an input.

    What answers at once and is gone within a sample or two looks like a fault of the sensor.
    """
    times = next(each.times for each in experiment.outputs if each.variable == output)
    after = np.zeros(len(times), bool)
    for given in experiment.inputs:
        after |= samples_after(times, jump_times(given))
    return after


def answers_to_inputs(experiment: Experiment, output: str) -> npt.NDArray[np.bool_]:
    """Return which samples of an output are just after a jump or a single pulse of an input.

    A peak that follows one, as of a flood after rain, is no fault of the sensor.
    """
    times = next(each.times for each in experiment.outputs if each.variable == output)
    after = after_jumps(experiment, output)
    for given in experiment.inputs:
        noise = LEAST_NOISE_OF_RANGE * float(np.ptp(given.values))
        pulses = isolated_outliers(given.values, noise).mask
        after |= samples_after(times, given.times[pulses], before=1)
    return after


def samples_after(
    times: FloatArray, events: FloatArray, *, before: int = 0, count: int = SAMPLES_AFTER_JUMP
) -> npt.NDArray[np.bool_]:
    """Return which of some times are the first after events, or so many samples before them."""
    after = np.zeros(len(times), bool)
    first = np.searchsorted(times, events)
    for late in range(-before, count):
        after[np.clip(first + late, 0, len(times) - 1)] = True
    return after


def _changes(values: FloatArray) -> npt.NDArray[np.bool_]:
    """Return for each interval between two samples whether the signal changes in it."""
    return np.asarray(np.abs(np.diff(values)) > 1e-9 * float(np.ptp(values)))


def _is_rounded(values: FloatArray, changes: npt.NDArray[np.bool_]) -> bool:
    """Return whether a signal goes from level to level like a slow one that was rounded.

    Each change is to the next level, of three or more, and they come at no regular times, as those
    of a staircase would.
    """
    levels = np.unique(values)
    if len(levels) <= 2:
        return False
    kept = np.diff(np.flatnonzero(changes))
    regular = not len(kept) or float(np.ptp(kept)) <= REGULAR * float(np.median(kept))
    next_one = np.abs(np.diff(np.searchsorted(levels, values))).max() == 1
    return bool(next_one) and not regular


MOST_NAMED_RECORDS = 3
"""Experiments that are named with their jumps; of more, those with the largest."""


@dataclass(frozen=True)
class JumpsOfRecord:
    """The jumps of an input in one experiment.

    Attributes
    ----------
    experiment
        Its id.
    count
        Of the jumps.
    time, before, after
        When the largest begins, in seconds, and from which value to which it goes.
    """

    experiment: str
    count: int
    time: float
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """Return how many there are, and where the largest is."""
        times = "once" if self.count == 1 else f"{self.count} times"
        largest = "" if self.count == 1 else ", by most"
        return (
            f"{times} in {self.experiment}{largest} at {self.time:.6g} s "
            f"from {self.before:.4g} to {self.after:.4g}"
        )


def jumping_inputs(
    experiments: Sequence[Experiment], holds: Callable[[str], bool]
) -> dict[str, tuple[JumpsOfRecord, ...]]:
    """Return the inputs that jump and are interpolated by straight lines, with where they do."""
    found: dict[str, list[JumpsOfRecord]] = {}
    for run in experiments:
        for given in run.inputs:
            if given.interpolation != "linear" or holds(given.variable):
                continue
            jumps, values = _jumps(given.times, given.values), given.values
            if len(jumps):
                at = int(jumps[np.argmax(np.abs(np.diff(values))[jumps])])
                here = float(given.times[at]), float(values[at]), float(values[at + 1])
                found.setdefault(given.variable, []).append(
                    JumpsOfRecord(run.id, len(jumps), *here)
                )
    return {name: tuple(records) for name, records in found.items()}


def jump_findings(
    experiments: Sequence[Experiment],
    holds: Callable[[str], bool],
    columns: Mapping[str, str],
) -> tuple[tuple[str, str], ...]:
    """Return what is wrong and what to do, for each input that jumps but is not held.

    Parameters
    ----------
    experiments
        Of a problem.
    holds
        Whether an input of this name is held whatever its interpolation is, as the FMU says that it
        changes at events alone.
    columns
        Of the table by key, as far as they are known: {"inputs.u": "force"}.
    """
    return tuple(
        (
            f"input {name}{_of_column(columns.get(f'inputs.{name}', ''))} jumps {_where(records)}; "
            "linear interpolation turns the jumps into ramps, which a fit may confuse with a delay",
            f"{interpolated(name, columns, 'hold')}, if the input keeps each sample until the next",
        )
        for name, records in jumping_inputs(experiments, holds).items()
    )


def interpolated(variable: str, columns: Mapping[str, str], how: Interpolation) -> str:
    """Return the key of a config that says how an input is interpolated."""
    column = columns.get(f"inputs.{variable}", "COLUMN")
    return f"{dotted('inputs', variable)} = {inline({'column': column, 'interpolation': how})}"


def _of_column(column: str) -> str:
    return f" (column {inline(column)})" if column else ""


def _where(records: Sequence[JumpsOfRecord]) -> str:
    """Name the experiments with the largest jumps."""
    largest = sorted(records, key=lambda each: -abs(each.after - each.before))
    named = ", ".join(each.sentence for each in largest[:MOST_NAMED_RECORDS])
    more = len(records) - MOST_NAMED_RECORDS
    return f"{named}, and in {more} more experiments" if more > 0 else named
