"""Communication points of co-simulation FMUs with a fixed communication step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.grid import SignalGrid, build_grid, on_times
from workers.messages import Experiment, FloatArray, IntArray, Model

ON_GRID = 1e-6
"""Distance from a communication point, in steps, below which a time counts as equal to it."""
ROUNDING_OF_STEPS = 2.0 * float(np.finfo(np.float64).eps)
"""Relative effect of rounding on the difference of two times, divided by the largest time."""


@dataclass(frozen=True)
class CommunicationPoints:
    """The communication points around the times of an experiment, for a fixed step.

    Attributes
    ----------
    grid
        The inputs at these points. Each interval is one step, or several steps without a kink of an
        input.
    step
        Seconds between two points.
    max_step
        Step with a margin for rounding, so that every interval is divided into steps of this
        length.
    before, after : (n,)
        The points before and after each time of the experiment.
    fractions : (n,)
        Distance of each time from the point before it, in steps; 0 if they are equal.
    linear : (recorded,)
        Whether a variable is interpolated. Others change only at events and are held.
    """

    grid: SignalGrid
    step: float
    max_step: float
    before: IntArray
    after: IntArray
    fractions: FloatArray
    linear: IntArray

    def interpolate(self, outputs: FloatArray) -> FloatArray:
        """Interpolate outputs, (points, m, recorded), at the experiment's n times."""
        values = outputs[:, self.before]
        between = np.flatnonzero(self.fractions > 0.0)
        first, second = outputs[:, self.before[between]], outputs[:, self.after[between]]
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are allowed
            interpolated = first + self.fractions[between, None] * (second - first)
        values[:, between] = np.where(self.linear, interpolated, first)
        return values


def communication_points(
    model: Model,
    description: ModelDescription,
    experiment: Experiment,
    recorded: tuple[str, ...],
    times: FloatArray,
) -> CommunicationPoints | None:
    """Return the communication points of an experiment; None for a variable step.

    Steps begin at the start of the experiment. Their length is `Solver.step`, otherwise that
    declared by the FMU, otherwise the shortest interval of the experiment if all others are
    multiples of it.

    Parameters
    ----------
    recorded
        The variables to record.
    times : (n,)
        Times of the experiment's grid: all inputs and all measurements.

    Raises
    ------
    ModelError
        If there is no such step, or it is too short.
    """
    if model.interface != "co_simulation" or description.variable_steps:
        return None
    step = _step(model, description, experiment, times)
    elapsed_steps = (times - experiment.start) / step
    nearest = np.round(elapsed_steps)
    on_point = np.abs(elapsed_steps - nearest) <= ON_GRID
    first = np.where(on_point, nearest, np.floor(elapsed_steps))
    last = np.where(on_point, nearest, first + 1.0)
    counts = np.unique(np.concatenate([first, last]))
    grid_times = experiment.start + counts * step
    # an input that jumps at such a time has already jumped, despite rounding
    sample_times = grid_times.copy()
    sample_times[np.searchsorted(counts, nearest[on_point])] = times[on_point]
    max_interval = float(np.diff(counts).max(initial=1.0))
    known = [description.variables.get(name) for name in recorded]
    return CommunicationPoints(
        grid=on_times(experiment, sample_times)._replace(times=grid_times),
        step=step,
        max_step=step * (1.0 + 0.5 / max_interval),
        before=np.searchsorted(counts, first),
        after=np.searchsorted(counts, last),
        fractions=np.where(on_point, 0.0, elapsed_steps - first),
        linear=np.array([each is not None and each.is_continuous for each in known], np.bool_),
    )


def step_lengths(times: FloatArray, own_step: float | None) -> FloatArray:
    """Return the intervals between times without the rounding errors of their differences.

    0.15 - 0.1 is 0.04999999999999999, and some FMUs refuse such a step. Several numbers agree with
    a difference within rounding. If a multiple of the FMU's own step is among them, it is returned.
    Otherwise, the number with the fewest digits is returned, unless a step of that length would end
    before the next time. Then an event at that time would be late.
    """
    differences = np.diff(times)
    lengths, positions = np.unique(differences, return_inverse=True)
    room = ROUNDING_OF_STEPS * float(np.abs(times).max())
    multiples = np.array([_multiple(each, room, own_step) for each in lengths.tolist()])[positions]
    shortest = np.array([_shortest(each, room) for each in lengths.tolist()])[positions]
    plain = np.where(times[:-1] + shortest >= times[1:], shortest, differences)
    return np.append(np.where(multiples > 0.0, multiples, plain), 0.0)


def _multiple(length: float, room: float, own_step: float | None) -> float:
    """Return the multiple of a step that equals a length within rounding, or 0."""
    found = own_step * round(length / own_step) if own_step else 0.0
    return found if abs(found - length) <= room else 0.0


def _shortest(length: float, room: float) -> float:
    """Return the number with the fewest digits that equals a length within rounding."""
    candidates = (float(f"{length:.{digits}g}") for digits in range(1, 16))
    return next((each for each in candidates if each > 0.0 and abs(each - length) <= room), length)


def communication_notes(
    model: Model, description: ModelDescription, experiments: Sequence[Experiment]
) -> tuple[str, ...]:
    """Return messages for the user about experiments whose values are interpolated.

    Raises
    ------
    ModelError
        As `communication_points`.
    """
    found: dict[float, list[str]] = {}
    for experiment in experiments:
        times = build_grid(experiment).times
        points = communication_points(model, description, experiment, experiment.recorded, times)
        if points is not None and points.fractions.any():
            found.setdefault(points.step, []).append(experiment.id)
    return tuple(_note(description.file, step, names) for step, names in found.items())


def _note(file: str, step: float, names: Sequence[str]) -> str:
    one = len(names) == 1
    which = f"experiment {names[0]!r}" if one else f"{len(names)} experiments"
    return (
        f"{file} communicates in fixed steps of {step:g} s, but {which} {'has' if one else 'have'} "
        "samples between these steps. There, real outputs are interpolated linearly, other outputs "
        "keep their last value, and inputs take effect at the next step. A shorter model.step "
        "reduces this error, if the FMU accepts it"
    )


def _step(
    model: Model, description: ModelDescription, experiment: Experiment, times: FloatArray
) -> float:
    where = f"experiment {experiment.id!r}"
    own = (description.fixed_internal_step, description.default_step)
    step = model.solver.step or next((s for s in own if s is not None and s > 0.0), None)
    if step is None:
        intervals = np.diff(times)
        step = float(intervals.min())
        steps = intervals / step
        if np.abs(steps - np.round(steps)).max() > ON_GRID:
            raise ModelError(
                f"{where}: {description.file} needs a fixed communication step, but does not name "
                f"one, and the times of inputs and measurements are {intervals.min():g} to "
                f"{intervals.max():g} s apart; set model.step to a step that the FMU accepts"
            )
    longest = float(np.diff(times).max(initial=0.0))
    if not longest / step <= model.solver.max_steps:
        raise ModelError(
            f"{where}: {description.file} must communicate in steps of {step:g} s, but times in "
            f"the data are up to {longest:g} s apart, which takes more than model.max_steps = "
            f"{model.solver.max_steps} steps; set model.step to a longer step that the FMU "
            "accepts, or raise model.max_steps"
        )
    return step
