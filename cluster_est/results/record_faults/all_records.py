"""Finds a column in a wrong unit, times in a wrong unit and late clocks, in all records alike.

A missing gain or dead time looks similar. So the fit with the correction must leave only noise in
training and held-out records. The number that corrects the records must follow from the data, with
all parameters free, and must be that of a usual confusion of units. No other column may do as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import make_interp_spline

from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.problem.tables.units import likely_conversions
from cluster_est.results.record_faults.changes import LARGEST_SHIFT, stretched, with_input
from cluster_est.results.record_faults.fault import RecordFault, Sort
from cluster_est.results.record_faults.fitted_records import (
    AT_NOISE,
    OFF,
    REFIT,
    FittedRecords,
    noise_rows,
)
from cluster_est.results.solver_error.measure import runner_beside
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.projection import OrthogonalProjection
from workers.messages import Experiment, FloatArray, Output

GROSS = 0.05
"""Least misfit of a fit, relative to the signals, for which conversions are tried. Conversions
change a column by a factor of 1.8 or more, so that a fit with a wrong one is poor."""
GROSS_IN_TIME = 0.3
"""The same for times in minutes or hours, whose simulations take 60 or 3600 times as long. A model
that is so much too slow does not follow its inputs at all."""
BETTER = 0.8
"""Largest ratio of the misfits with and without a conversion for a refit."""
MOST_REFITS = 3
"""Largest number of conversions that are refitted."""
RANKED_ON = 2
"""Number of records, those with the largest residuals, on which conversions are compared first."""
STANDARD_ERRORS = 4.0
"""Half width of an interval in standard errors. Theory: the noise may be coloured."""
PRECISE = 0.03
"""Largest half width of the interval of a factor, and of an offset relative to its conversion. By
chance, one of some fifty gains between 0.001 and 1000 is so close to a given conversion."""
STEP = 1e-3
"""Step of the differences for a factor, and for an offset relative to its conversion."""
PROMISED = 0.5
"""Least share of the squares beyond the noise that a shift must explain, to first order."""
ROUNDS = 3
"""Refits with a better estimate of the shift."""


@dataclass(frozen=True)
class SharedChange:
    """A correction of columns, or of the times, in all records.

    Attributes
    ----------
    sort, names
        What is corrected.
    unit
        The confusion of units, such as "rpm instead of rad/s".
    factor, offset
        Factor and offset that correct a column, or the factor of the times.
    late
        Seconds by which the columns are late.
    """

    sort: Sort
    names: tuple[str, ...]
    unit: str = ""
    factor: float = 1.0
    offset: float = 0.0
    late: float = 0.0

    @property
    def takes_longer(self) -> bool:
        """Whether the changed experiments take longer."""
        return self.sort == "times" and self.factor > 1.0

    def of(self, run: Experiment) -> Experiment:
        """Return the corrected experiment."""
        if self.sort == "times":
            return stretched(run, self.factor)
        if self.sort == "inputs":
            return with_input(run, self.names[0], self.factor, self.offset, self.late)
        pairs = [(o, o.variable in self.names) for o in run.outputs]
        return replace(run, outputs=tuple(self._output(run, o) if own else o for o, own in pairs))

    def _output(self, run: Experiment, output: Output) -> Output:
        """Return the corrected output; its sigma may be in either unit, so the least is taken."""
        times, sigma = output.times - self.late, min(1.0, abs(self.factor)) * output.sigma
        values = self.factor * output.values + self.offset
        changed = replace(output, times=times, values=values, sigma=sigma)
        return changed.only((times >= run.start) & (times <= run.stop)) if self.late else changed

    def neighbours(self, runs: Sequence[Experiment]) -> list[tuple[SharedChange, float]]:
        """Return changes with a slightly larger factor, and offset if there is one; their steps.

        The factor turns around the mean of the column, so that it does not act as an offset.
        """
        larger = replace(self, factor=self.factor * (1.0 + STEP))
        if not self.offset:
            return [(larger, STEP)]
        columns = [(c.variable, c.values) for run in runs for c in run.inputs]
        columns += [(c.variable, c.values) for run in runs for c in run.outputs]
        mean = np.mean(np.concatenate([values for name, values in columns if name in self.names]))
        turned = replace(larger, offset=self.offset - STEP * self.factor * float(mean))
        return [(turned, STEP), (replace(self, offset=self.offset * (1.0 + STEP)), STEP)]


@dataclass(frozen=True)
class ChangedFit:
    """A fit to records with a correction.

    Attributes
    ----------
    space, x
        The search space, with the corrected records, and the estimates.
    residuals : (n,), jacobian : (n, unknowns), scale : (n,)
        Residuals of the training records, their derivatives and their noise.
    after, held_out
        The largest residual of an output of a training and of a held-out record, over the noise.
    """

    space: SearchSpace
    x: FloatArray = field(repr=False)
    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    scale: FloatArray = field(repr=False)
    after: float
    held_out: float = np.inf

    @property
    def fits(self) -> bool:
        """Whether the fit leaves only noise."""
        return self.after <= AT_NOISE and self.held_out <= AT_NOISE

    def step(self, directions: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the best step of a change, with all parameters refitted to first order.

        Parameters
        ----------
        directions : (n, numbers)
            Derivatives of the residuals by the numbers of the change.

        Returns
        -------
        steps, widths : (numbers,)
            Steps and half widths of their intervals; infinite if parameters have the same effect.
        share
            Share of the squares beyond the noise that the step removes.
        """
        project = OrthogonalProjection(self.jacobian / self.scale[:, None]).remove
        rest, own = project(self.residuals / self.scale), directions / self.scale[:, None]
        left = project(own)
        if not np.all(np.linalg.norm(left, axis=0) > 1e-6 * np.linalg.norm(own, axis=0)):
            nothing = np.zeros(own.shape[1])
            return nothing, nothing + np.inf, 0.0
        steps = np.asarray(np.linalg.lstsq(left, -rest, rcond=1e-9)[0])
        inverse = np.linalg.pinv(left.T @ left, rcond=1e-12, hermitian=True)
        total = float(rest @ rest)
        share = (total - np.sum((rest + left @ steps) ** 2)) / max(total - len(rest), 1e-300)
        widths = STANDARD_ERRORS * np.sqrt(np.diag(inverse)) * max(self.after, 1.0)
        return steps, widths, float(share)


def unit_of_all_records(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find a column, or the times, in another unit in all records."""
    before = float(fitted.levels(fitted.residuals, fitted.runs, fitted.noise_here).max())
    misfit = _misfit(fitted.runs, fitted.residuals)
    if not before > OFF or not misfit > GROSS:
        return ()
    known = [c for c in _conversions(fitted) if not c.takes_longer or misfit > GROSS_IN_TIME]
    unchanged, *misfits = _misfits(fitted, [SharedChange("times", ()), *known], {})
    found = []
    for change in _best(known, misfits, unchanged):
        fit = _fit(fitted, change, {})
        if fit is not None and fit.fits:
            found.append((change, fit))
    if len({(change.sort, change.names) for change, _ in found}) != 1:
        return ()
    change, fit = min(found, key=lambda each: each[1].after)
    if not _is_determined(fitted, change, fit) or _others_do(fitted, change, fit, unchanged):
        return ()
    gain, offset = 1.0 / change.factor, -change.offset / change.factor
    parts = [f"a gain of {gain:.4g}"] if gain != 1.0 else []
    parts += [f"an offset of {offset:.4g}"] if offset else []
    alike = f"{' and '.join(parts)} that the model lacks or has in a wrong fixed parameter"
    if change.sort == "times":
        alike = "rates of the model that are all wrong by this factor"
    fault = RecordFault(
        "unit", "", change.sort, change.names, gain, before, fit.after, change.unit,
        (alike,), factor=change.factor, offset=change.offset,
        held_out=fit.held_out,
    )  # fmt: skip
    return (fault,)


def _conversions(fitted: FittedRecords) -> list[SharedChange]:
    """Return the conversions of the times and of each column from units that are often mistaken."""
    variables = fitted.problem.describe().variables
    units: list[tuple[Sort, str, str]] = [("times", "times", "s")]
    units += [(*column, variables[column[1]].unit) for column in _columns(fitted)]
    return [
        SharedChange(sort, (name,), f"{other} instead of {unit}", change.factor, change.offset)
        for sort, name, unit in units
        for other, change in likely_conversions(unit).items()
    ]


def _columns(fitted: FittedRecords) -> list[tuple[Sort, str]]:
    """Return the inputs and outputs that vary."""
    found: dict[tuple[Sort, str], None] = {}
    for run in fitted.runs:
        found |= {("inputs", i.variable): None for i in run.inputs if np.ptp(i.values) > 0.0}
        found |= {("outputs", o.variable): None for o in run.outputs if len(o.times) > 3}
    return list(found)


def _best(
    changes: Sequence[SharedChange], misfits: Sequence[float], unchanged: float
) -> list[SharedChange]:
    """Return the changes with the least misfits, if they are clearly less than without."""
    order = np.argsort(misfits, kind="stable")[:MOST_REFITS]
    return [changes[n] for n in order.tolist() if misfits[n] < BETTER * unchanged]


def _misfits(
    fitted: FittedRecords, changes: Sequence[SharedChange], values: dict[str, float]
) -> list[float]:
    """Return the misfit of a few records with each change, at the start values or at others."""
    levels = fitted.levels(fitted.residuals, fitted.runs, fitted.noise_here)
    places = np.argsort(-levels, kind="stable")[:RANKED_ON]
    space = make_space(fitted.problem, fitted.train, starts=values)
    runs = [change.of(fitted.runs[place]) for change in changes for place in places]
    rows = np.tile(space.physical(space.start)[places], (len(changes), 1))
    found = [
        np.inf if rest is None else _misfit([run], rest)
        for run, rest in zip(runs, fitted.simulate(runs, rows), strict=True)
    ]
    return [float(each) for each in np.mean(np.reshape(found, (len(changes), -1)), axis=1)]


def _misfit(runs: Sequence[Experiment], residuals: FloatArray) -> float:
    """Return the mean error of the outputs relative to their signals; about 1 for a wrong scale.

    Measured and simulated signals count alike, so that a conversion to small values has no
    advantage.
    """
    outputs = [o for run in runs for o in run.outputs]
    parts = np.split(residuals, np.cumsum([len(o.times) for o in outputs])[:-1])
    errors = []
    for output, rest in zip(outputs, parts, strict=True):
        if len(rest):
            simulated = output.values - output.sigmas * rest
            apart = np.mean(output.values) - np.mean(simulated)
            size = np.hypot(np.hypot(np.std(output.values), np.std(simulated)), apart)
            errors.append(np.sqrt(np.mean((output.sigmas * rest) ** 2)) / (size or 1.0))
    return float(np.mean(errors)) if np.all(np.isfinite(errors)) else np.inf


def _fit(
    fitted: FittedRecords, change: SharedChange, starts: dict[str, float]
) -> ChangedFit | None:
    """Fit the corrected records, and predict the held-out ones; None if it fails."""
    runs = tuple(change.of(run) for run in fitted.problem.experiments)
    problem = replace(fitted.problem, experiments=runs)
    space = make_space(problem, fitted.train, starts=starts)
    solver = fitted.limited_solver(runs)
    with runner_beside(problem, runs, solver, fitted.resources, fitted.runner) as runner:
        (solution,) = runner.run([SearchRequest("records", REFIT, space)])
        at, found = solution.at, None
        if at is not None and at.ok and solution.jacobian is not None:
            train, residuals = [runs[e] for e in fitted.train], np.asarray(at.residuals)
            noise = fitted.noise(residuals, train)
            after = float(fitted.levels(residuals, train, noise).max())
            held_out = np.inf
            if after <= AT_NOISE:
                held_out = _held_out(fitted, space, solution.x, noise, runner)
            scale = noise_rows(train, noise)
            found = ChangedFit(
                space, solution.x, residuals, solution.jacobian, scale, after, held_out
            )
        fitted.count(runner.simulations)
    return found


def _held_out(
    fitted: FittedRecords, space: SearchSpace, x: FloatArray, noise: FloatArray, runner: Runner
) -> float:
    """Return the largest residual of held-out records over the noise; 0 without such records.

    Values that only these records have, such as initial states, are fitted to them.
    """
    runs, outputs = space.problem.experiments, fitted.records.outputs
    tests = tuple(
        n for n, run in enumerate(runs)
        if run.role == "test" and tuple(o.variable for o in run.outputs) == tuple(outputs)
    )  # fmt: skip
    if not tests:
        return 0.0
    own = make_space(space.problem, tests, known=space.estimates(x))
    values = own.physical(own.start)
    if own.size:
        (solution,) = runner.run([SearchRequest("records", REFIT, own)])
        values = own.physical(solution.x)
    found = runner.simulate(values, tests, "residuals", "records", space.problem.effects)
    parts = [each.residuals for each in found if each.ok and each.residuals is not None]
    if len(parts) < len(tests):
        return np.inf
    return float(fitted.levels(np.concatenate(parts), [runs[n] for n in tests], noise).max())


def _is_determined(fitted: FittedRecords, change: SharedChange, fit: ChangedFit) -> bool:
    """Return whether the data, with all parameters free, lead to the numbers of the conversion."""
    directions = []
    for moved, step in change.neighbours(fitted.runs):
        values = fit.space.physical(fit.x)
        answers = fitted.simulate([moved.of(run) for run in fitted.runs], values)
        known = [each for each in answers if each is not None]
        if len(known) < len(answers):
            return False
        directions.append((np.concatenate(known) - fit.residuals) / step)
    steps, widths, _ = fit.step(np.column_stack(directions))
    return bool(np.all(np.abs(steps) <= widths) and np.all(np.abs(steps) + widths <= PRECISE))


def _others_do(
    fitted: FittedRecords, change: SharedChange, fit: ChangedFit, unchanged: float
) -> bool:
    """Return whether the same factor at another column explains the records too."""
    others = [
        SharedChange(sort, (name,), factor=factor)
        for sort, name in _columns(fitted)
        for factor in (change.factor, 1.0 / change.factor)
        if factor != 1.0 and (sort, (name,)) != (change.sort, change.names)
    ]
    estimates = fit.space.estimates(fit.x)
    chosen = _best(others, _misfits(fitted, others, estimates), unchanged) if others else []
    return _any_fits(fitted, chosen, estimates)


def _any_fits(
    fitted: FittedRecords, changes: Sequence[SharedChange], starts: dict[str, float]
) -> bool:
    found = (_fit(fitted, change, starts) for change in changes)
    return any(each is not None and each.fits for each in found)


def clock_of_all_records(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find outputs that are all equally late relative to all inputs.

    A single late input or output may have a dead time that the model lacks.
    """
    columns = _columns(fitted)
    outputs = tuple(name for sort, name in columns if sort == "outputs")
    before = float(fitted.levels(fitted.residuals, fitted.runs, fitted.noise_here).max())
    if not before > OFF or min(len(outputs), len(columns) - len(outputs)) < 2:
        return ()
    scale = noise_rows(fitted.runs, fitted.noise_here)
    fit = ChangedFit(fitted.space, fitted.x, fitted.residuals, fitted.jacobian, scale, before)
    late, most = 0.0, LARGEST_SHIFT * min(run.stop - run.start for run in fitted.runs)
    for _ in range(ROUNDS):
        (step,), _, share = fit.step(_slopes(fit))
        late += float(step)
        change = SharedChange("outputs", outputs, late=late)
        promising = share > PROMISED and abs(late) < most
        found = _fit(fitted, change, fitted.estimates) if promising else None
        if found is None:
            return ()
        fit = found
        if fit.fits:
            break
    if not fit.fits or not fit.step(_slopes(fit))[1][0] < abs(late):
        return ()
    alone = [
        SharedChange(sort, (name,), late=late if sort == "outputs" else -late)
        for sort, name in columns
    ]
    if _any_fits(fitted, alone, fit.space.estimates(fit.x)):
        return ()
    fault = RecordFault(
        "clock", "", "outputs", outputs, late, before, fit.after,
        others=("a dead time of all inputs that the model lacks",), held_out=fit.held_out,
    )  # fmt: skip
    return (fault,)


def _slopes(fit: ChangedFit) -> FloatArray:
    """Return the derivative of the residuals by a shift of all outputs to earlier times."""
    found = []
    runs = [fit.space.problem.experiments[e] for e in fit.space.experiments]
    outputs = [o for run in runs for o in run.outputs]
    parts = np.split(fit.residuals, np.cumsum([len(o.times) for o in outputs])[:-1])
    for output, rest in zip(outputs, parts, strict=True):
        slope, simulated = np.zeros(len(rest)), output.values - output.sigmas * rest
        if len(rest) > 3:
            slope = make_interp_spline(output.times, simulated, 3)(output.times, 1)
        found.append(slope / output.sigmas)
    return np.concatenate(found)[:, None]
