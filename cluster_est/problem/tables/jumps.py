"""Finds jumps in signals such as a switch, a set point or the output of a controller.

Between jumps, these signals keep their value or change in small steps.

Linear interpolation turns a jump between two samples into a ramp, which begins up to a sampling
interval too early. A fit may confuse this with a delay or a lag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.problem.display import in_a_row, plain_number
from cluster_est.statistics.noise.outliers import isolated_outliers
from cluster_est.toml import dotted, inline
from workers.messages import Experiment, FloatArray, Input, Interpolation

LEAST_SAMPLES_WITH_JUMPS = 10
LEAST_REPEATED_SHARE = 0.5
"""Least share of the samples that repeat the previous sample."""
LEAST_ISOLATED_SHARE = 0.8
"""Least share of isolated changes, with repeated samples before and after."""
LEAST_JUMP = 0.05
"""Least median change, over the range of the signal; smaller changes are the steps of an A/D
converter."""
NEAR_STEPS = 3
"""Number of steps on each side with which a jump of a moving signal is compared."""
OVER_NEAR_STEPS = 6.0
"""Least size of such a jump, over the largest of these steps."""
USUAL_STEPS, OVER_USUAL_STEPS = 0.75, 5.0
"""A quantile of the sizes of all steps, and the least size of such a jump over this quantile."""
LEAST_JUMPS_WHILE_MOVING = 2
"""Least number of jumps of a moving signal; a single jump may have another cause."""
SAMPLES_AFTER_JUMP = 3
"""Number of samples from the jump of an input on in which a fast response occurs."""
LEAST_NOISE_OF_RANGE = 0.01
"""Least noise of a signal over its range, for the detection of isolated samples."""
REGULAR = 0.1
"""Largest range of the times between changes of a staircase, over their median."""
FEW_SAMPLES = 6
"""Least number of samples that show whether a signal is recorded only when it changes."""
NEAR_USUAL, REGULAR_SHARE = 0.1, 0.75
"""Samples are regular if at least this share of their intervals is near the median, to within the
first number times the median."""
DIFFERENT_SHARE, LEAST_STEP, SMOOTH = 0.9, 0.1, 0.5
"""A signal that is recorded only when it changes differs from sample to sample with at least this
share; its median change is at least the second number times its range; and the median distance of a
sample from the line through its neighbours is at least the third number times the median change."""


def count_jumps(times: FloatArray, values: FloatArray) -> int:
    """Return the number of jumps of a signal.

    A steep ramp between two points that are closer than the other samples is not a jump.

    Parameters
    ----------
    times, values : (n,)
        Times and values of the samples, in the order of time.
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
    """Return the jumps of a signal that changes in small steps between them.

    A jump is much larger than all nearby steps on both sides, and than most steps of the signal. A
    spike consists of two large neighbouring steps, and steps of noise are as large as their
    neighbours, so neither is a jump.
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
    moves = usual > 1e-9 * float(np.ptp(values))  # otherwise, the signal has levels
    return found if moves and len(found) >= LEAST_JUMPS_WHILE_MOVING else found[:0]


def regular(times: FloatArray) -> bool:
    """Return whether most intervals between samples have the same length; False for few samples."""
    if len(times) < FEW_SAMPLES:
        return False
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    return bool(np.mean(np.abs(intervals - usual) <= NEAR_USUAL * usual) >= REGULAR_SHARE)


def recorded_at_changes(times: FloatArray, values: FloatArray) -> bool:
    """Return whether a signal seems to be recorded only when it changes, and to jump then.

    Its samples are irregular, its value is another one at each sample, and lines through the
    neighbours of a sample do not lead to it. A slowly sampled temperature is regular or smooth.
    """
    if len(values) < FEW_SAMPLES or regular(times) or not np.isfinite(values).all():
        return False
    if not (np.diff(times) > 0.0).all():
        return False
    if np.mean(_changes(values)) < DIFFERENT_SHARE:
        return False
    usual = float(np.median(np.abs(np.diff(values))))
    between = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    line = values[:-2] + between * (values[2:] - values[:-2])
    off = float(np.median(np.abs(values[1:-1] - line)))
    return usual >= LEAST_STEP * float(np.ptp(values)) and off >= SMOOTH * usual


def jump_times(given: Input) -> FloatArray:
    """Return the times at which the jumps of an input begin.

    If a held input is recorded only when it changes, each change is a jump.
    """
    jumps = _jumps(given.times, given.values)
    if given.interpolation == "hold" and recorded_at_changes(given.times, given.values):
        jumps = np.flatnonzero(_changes(given.values))
    return given.times[jumps if given.interpolation == "linear" else jumps + 1]


def after_jumps(experiment: Experiment, output: str) -> npt.NDArray[np.bool_]:
    """Return a mask of the samples of an output just after a jump of an input.

    An immediate response that lasts one or two samples resembles a sensor fault.
    """
    times = next(each.times for each in experiment.outputs if each.variable == output)
    after = np.zeros(len(times), bool)
    for given in experiment.inputs:
        after |= samples_after(times, jump_times(given))
    return after


def answers_to_inputs(experiment: Experiment, output: str) -> npt.NDArray[np.bool_]:
    """Return a mask of the samples of an output just after a jump or a pulse of an input.

    A peak after a jump or a pulse, such as a flood after rain, is not a sensor fault.
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
    """Return a mask of `count` times from each event on, and of `before` times before it."""
    after = np.zeros(len(times), bool)
    first = np.searchsorted(times, events)
    for late in range(-before, count):
        after[np.clip(first + late, 0, len(times) - 1)] = True
    return after


def _changes(values: FloatArray) -> npt.NDArray[np.bool_]:
    """Return a mask of the intervals between samples in which the signal changes."""
    return np.asarray(np.abs(np.diff(values)) > 1e-9 * float(np.ptp(values)))


def _is_rounded(values: FloatArray, changes: npt.NDArray[np.bool_]) -> bool:
    """Return whether a signal resembles a slow signal that was rounded.

    It has three or more levels, each change leads to the next level, and the times between changes
    are not regular. The changes of a staircase are regular.
    """
    levels = np.unique(values)
    if len(levels) <= 2:
        return False
    kept = np.diff(np.flatnonzero(changes))
    regular = not len(kept) or float(np.ptp(kept)) <= REGULAR * float(np.median(kept))
    next_one = np.abs(np.diff(np.searchsorted(levels, values))).max() == 1
    return bool(next_one) and not regular


MOST_NAMED_RECORDS = 3
"""Largest number of experiments that a text names; those with the largest jumps are named."""


@dataclass(frozen=True)
class JumpsOfRecord:
    """The jumps of an input in one experiment.

    Attributes
    ----------
    experiment
        Id of the experiment.
    count
        Number of jumps.
    time, before, after
        Time of the largest jump in seconds, and the values before and after it.
    """

    experiment: str
    count: int
    time: float
    before: float
    after: float

    @property
    def sentence(self) -> str:
        """The experiment and the number of jumps, as a text."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"{self.experiment!r} ({times})"

    def size(self, unit: str) -> str:
        """Return the time and the size of the largest jump as a text."""
        unit = f" {unit}" if unit not in ("", "1") and "?" not in unit else ""
        return (
            f"from {plain_number(self.before)} to {plain_number(self.after)}{unit} at "
            f"t = {plain_number(self.time, 6)} s in {self.experiment!r}"
        )


def jumping_inputs(
    experiments: Sequence[Experiment], holds: Callable[[str], bool]
) -> dict[str, tuple[JumpsOfRecord, ...]]:
    """Return the jumps of all inputs that jump but are interpolated linearly, by input."""
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
    unit_of: Callable[[str], str] = lambda _: "",
) -> tuple[tuple[str, str], ...]:
    """Return a finding and an advice for each input that jumps but is not held.

    Parameters
    ----------
    experiments
        The experiments of a problem.
    holds
        A function that returns whether an input with this name is always held, because the FMU
        declares that it changes only at events.
    columns
        The known columns of the table by config key, such as {"inputs.u": "force"}.
    unit_of
        A function that returns the unit of an input.
    """
    return tuple(
        (
            f"input {name}{of_column(name, columns)} jumps between samples in "
            f"{_where(records, unit_of(name))}; linear interpolation turns each jump into a ramp, "
            "and a ramp can look like a delay, a lag or a rate limit of the input",
            f"if the real input keeps each value until the next sample, set "
            f"{interpolated(name, columns, 'hold')} in the experiments{_fill_in(name, columns)} "
            "and run again",
        )
        for name, records in jumping_inputs(experiments, holds).items()
    )


def _fill_in(variable: str, columns: Mapping[str, str]) -> str:
    """Say what COLUMN stands for; "" if the column is known."""
    known = f"inputs.{variable}" in columns
    return "" if known else ", with the name of its column instead of COLUMN,"


def interpolated(variable: str, columns: Mapping[str, str], how: Interpolation) -> str:
    """Return the config line that sets the interpolation of an input."""
    value = {"column": columns.get(f"inputs.{variable}", "COLUMN"), "interpolation": how}
    clock = columns.get(f"inputs.{variable}.time")
    return f"{dotted('inputs', variable)} = {inline(value | ({'time': clock} if clock else {}))}"


def of_column(variable: str, columns: Mapping[str, str]) -> str:
    """Return the column of an input as a text in brackets; "" if it is not known."""
    column = columns.get(f"inputs.{variable}", "")
    return f" (column {inline(column)})" if column else ""


def _where(records: Sequence[JumpsOfRecord], unit: str) -> str:
    """Return a text on the experiments with the largest jumps, and on the largest jump."""
    largest = sorted(records, key=lambda each: -abs(each.after - each.before))
    named = [each.sentence for each in largest[:MOST_NAMED_RECORDS]]
    more = len(records) - MOST_NAMED_RECORDS
    if more > 0:
        named.append(f"{more} more")
    several = len(records) > 1
    first = largest[0]
    what = "the jump is" if not several and first.count == 1 else "the largest jump is"
    return f"experiment{'s' if several else ''} {in_a_row(named)}; {what} {first.size(unit)}"
