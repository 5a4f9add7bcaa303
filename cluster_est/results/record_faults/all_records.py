"""Faults that all records share: a column in another unit, a clock that is off everywhere.

A correction that is the same in all records is tried where the fit stands and from the start
values, and believed where all records then fit at the level of the noise after a refit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from cluster_est.methods.method import Solution
from cluster_est.results.record_faults.changes import conversions, with_input
from cluster_est.results.record_faults.fault import RecordFault, Sort, as_unit
from cluster_est.results.record_faults.fitted_records import (
    AT_NOISE,
    OFF,
    FittedRecords,
    converted,
)
from cluster_est.statistics.projection import OrthogonalProjection
from workers.messages import Experiment, FloatArray

GROSS = 0.1
"""Residual over the spread of an output from which on a unit may be wrong everywhere."""
BETTER = 0.5
"""Part of the error at the start values that a unit must leave at most to be refitted."""
MOST_REFITS = 2
"""Units that are refitted, the best first."""
ROUNDS = 2
"""Refits with a better clock."""
PROMISED = 0.5
"""Share of the squares beyond the noise that the linear model must promise of a moved clock."""
LEAST_STEPS = 0.5
"""Samples that a clock must be off by."""


def unit_everywhere(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find a column that is in another unit in all records."""
    noise = fitted.noise_here
    before = float(fitted.levels(fitted.residuals, fitted.runs, noise).max())
    if not before > OFF or not _relative(fitted.residuals, fitted.runs) > GROSS:
        return ()
    usual, ranked = _ranked_conversions(fitted)
    for error, entry in ranked[:MOST_REFITS]:
        if error > BETTER * usual:
            break
        fault = _confirmed_unit(fitted, entry, before)
        if fault is not None:
            return (fault,)
    return ()


Entry = tuple[Sort, str, float, float]


def _ranked_conversions(fitted: FittedRecords) -> tuple[float, list[tuple[float, Entry]]]:
    """Return the error at the start values, and that with each conversion, the least first."""
    count, runs = len(fitted.runs), list(fitted.runs)
    inputs = dict.fromkeys(given.variable for run in fitted.runs for given in run.inputs)
    of_inputs: list[Entry] = [("inputs", name, *way) for name in inputs for way in conversions()]
    for _, name, factor, offset in of_inputs:
        runs += [with_input(run, name, factor, offset) for run in fitted.runs]
    values = fitted.space.physical(fitted.space.start)
    answers = fitted.simulate(runs, np.tile(values, (len(of_inputs) + 1, 1)))
    start = _joined(answers[:count])
    if start is None:
        return 0.0, []
    found: list[tuple[float, Entry]] = []
    for number, entry in enumerate(of_inputs, start=1):
        residuals = _joined(answers[number * count : (number + 1) * count])
        if residuals is not None:
            found.append((_relative(residuals, fitted.runs), entry))
    for name in dict.fromkeys(o.variable for run in fitted.runs for o in run.outputs):
        for way in conversions():
            changed = [_converted(run, name, *way) for run in fitted.runs]
            residuals = _converted_residuals(fitted.runs, changed, start)
            found.append((_relative(residuals, changed), ("outputs", name, *way)))
    found.sort(key=lambda each: each[0])
    return _relative(start, fitted.runs), found


def _converted(run: Experiment, name: str, factor: float, offset: float) -> Experiment:
    outputs = tuple(converted(o, factor, offset) if o.variable == name else o for o in run.outputs)
    return replace(run, outputs=outputs)


def _converted_residuals(
    runs: list[Experiment], changed: list[Experiment], residuals: FloatArray
) -> FloatArray:
    """Residuals of the same simulations beside converted measurements."""
    parts, first = [], 0
    for run, other in zip(runs, changed, strict=True):
        for old, new in zip(run.outputs, other.outputs, strict=True):
            rows = slice(first, first + len(old.times))
            first = rows.stop
            simulated = old.values - old.sigmas * residuals[rows]
            parts.append((new.values - simulated) / new.sigmas)
    return np.concatenate(parts)


def _joined(answers: list[FloatArray | None]) -> FloatArray | None:
    known = [each for each in answers if each is not None]
    return np.concatenate(known) if len(known) == len(answers) else None


def _relative(residuals: FloatArray, runs: list[Experiment]) -> float:
    """Return the largest error of an output over its spread, over all records."""
    errors: dict[str, list[FloatArray]] = {}
    values: dict[str, list[FloatArray]] = {}
    first = 0
    for run in runs:
        for output in run.outputs:
            rows = slice(first, first + len(output.times))
            first = rows.stop
            errors.setdefault(output.variable, []).append(residuals[rows] * output.sigmas)
            values.setdefault(output.variable, []).append(output.values)
    found = 0.0
    for name, parts in errors.items():
        spread = float(np.std(np.concatenate(values[name])))
        with np.errstate(over="ignore"):
            error = float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
        found = max(found, error / spread if spread > 0.0 else np.inf)
    return found if np.isfinite(found) else np.inf


def _confirmed_unit(fitted: FittedRecords, entry: Entry, before: float) -> RecordFault | None:
    sort, name, factor, offset = entry

    def change(run: Experiment) -> Experiment:
        if sort == "outputs":
            return _converted(run, name, factor, offset)
        return with_input(run, name, factor, offset)

    solution, runs = fitted.refit_changed(change, {})
    after = _level(fitted, solution, runs)
    if not after <= AT_NOISE:
        return None
    unit = as_unit(1.0 / factor, -offset / factor, 0.0)
    return RecordFault(
        "unit", "", sort, (name,), 1.0 / factor, before, after, unit, factor=factor, offset=offset
    )


def _level(fitted: FittedRecords, solution: Solution, runs: list[Experiment]) -> float:
    if solution.at is None or not solution.at.ok:
        return np.inf
    residuals = solution.at.residuals
    return float(fitted.levels(residuals, runs, fitted.noise(residuals, runs)).max())


def clock_everywhere(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find outputs that are all equally late in all records.

    One output alone that is late may be a dead time of its sensor: that is a part of the model.
    """
    names = {o.variable for run in fitted.runs for o in run.outputs if len(o.times) > 3}
    if len(names) < 2:
        return ()
    noise = fitted.noise_here
    before = float(fitted.levels(fitted.residuals, fitted.runs, noise).max())
    if not before > OFF:
        return ()
    step = min(
        float(np.median(np.diff(o.times)))
        for r in fitted.runs
        for o in r.outputs
        if len(o.times) > 3
    )
    moved, promised = _clock_step(fitted.runs, fitted.residuals, fitted.jacobian, noise, fitted)
    if promised < PROMISED:
        return ()
    late, start, after = 0.0, fitted.estimates, np.inf
    for _ in range(ROUNDS):
        late += moved
        if abs(late) > 0.1 * min(run.stop - run.start for run in fitted.runs):
            return ()
        solution, runs = fitted.refit_changed(lambda run, by=late: _earlier(run, by), start)  # type: ignore[misc]
        after = _level(fitted, solution, runs)
        if after <= AT_NOISE or solution.at is None or solution.jacobian is None:
            break
        residuals = solution.at.residuals
        noise = fitted.noise(residuals, runs)
        moved, _ = _clock_step(runs, residuals, solution.jacobian, noise, fitted)
    if not after <= AT_NOISE or abs(late) < LEAST_STEPS * step:
        return ()
    outputs = tuple(sorted(names))
    return (RecordFault("clock", "", "outputs", outputs, late, before, after),)


def _clock_step(
    runs: list[Experiment],
    residuals: FloatArray,
    jacobian: FloatArray,
    noise: FloatArray,
    fitted: FittedRecords,
) -> tuple[float, float]:
    """Return by how much all outputs are late, and the share beyond the noise that it explains."""
    slopes, sizes, first = [], [], 0
    names = list(fitted.records.outputs)
    for run in runs:
        for output in run.outputs:
            rows = slice(first, first + len(output.times))
            first = rows.stop
            simulated = output.values - output.sigmas * residuals[rows]
            slope = np.zeros(len(output.times))
            if len(output.times) > 3:
                slope = CubicSpline(output.times, simulated)(output.times, 1)
            slopes.append(slope / output.sigmas)
            sizes.append(np.full(len(output.times), noise[names.index(output.variable)]))
    scale = np.concatenate(sizes)
    projection = OrthogonalProjection(jacobian / scale[:, None])
    left = projection.remove(residuals / scale)
    slope = projection.remove(np.concatenate(slopes) / scale)
    square, total = float(slope @ slope), float(left @ left)
    if not square > 0.0:
        return 0.0, 0.0
    late = -float(slope @ left) / square
    return late, late**2 * square / max(total - len(left), 1e-300)


def _earlier(run: Experiment, by: float) -> Experiment:
    """Return an experiment whose outputs were measured earlier."""
    outputs = []
    for output in run.outputs:
        times = output.times - by
        kept = (times >= run.start) & (times <= run.stop)
        outputs.append(replace(output.only(kept), times=times[kept]))
    return replace(run, outputs=tuple(outputs))
