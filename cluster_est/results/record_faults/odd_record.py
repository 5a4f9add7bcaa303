"""Finds an odd record: one change corrects it, and the model fits all other records.

If a model lacks something, it misfits several records, and no gain, shift or exchange of columns
corrects one of them. So there are three conditions. A fit to the other records leaves only noise.
The record that was left out is far from the prediction of this fit. With one change of one column,
the fit to this record is as good as to the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results.record_faults.changes import MendedRecord, OddRecord, mended
from cluster_est.results.record_faults.fault import RecordFault, as_unit
from cluster_est.results.record_faults.fitted_records import (
    AT_NOISE,
    OFF,
    FittedRecords,
    noise_rows,
)
from cluster_est.statistics.projection import OrthogonalProjection
from workers.messages import Experiment, FloatArray

FEWEST_RECORDS = 3
"""Least number of records; with two records, the odd one cannot be identified."""
MOST_LEFT_OUT = 6
"""Largest number of records that are left out, one at a time; those are chosen without which the
linear model predicts the best fit."""
MANY, FEW = 8, 2
"""Number of records above which a single record hardly changes a fit, so that the linear model is
accurate; number of records that are then left out, one at a time."""
SUSPECTED = 20
"""Largest number of records for the linear model; those with the largest residuals are chosen."""
SAME = 10.0
"""Difference of sums of squares over the noise up to which two changes are equally good. Theory:
the same strength of evidence as `REFINEMENT.alternative`."""
GROSS = 20.0
"""Ratio of residual to noise above which the faulty record may have led the fit to a wrong minimum.
Then the fits to the other records also start at the start values."""
LEAST_GAIN = 0.03
"""Least distance of a gain from 1 for a fault; a calibration error may be smaller."""
PASSES = 6
"""Passes over the changes of a record with its own unknowns, such as an initial state. They are
repeated because the estimates of these unknowns partly compensated the fault."""
PLAINEST = (
    "swapped", "sign", "unit", "clock", "delay", "gain", "offset", "initial state",
)  # fmt: skip
"""Order of the kinds; of equally good changes, the first one is named."""


@dataclass(frozen=True)
class LeftOut:
    """A fit to all records but one."""

    position: int
    space: SearchSpace
    solution: Solution = field(repr=False)

    @property
    def is_known(self) -> bool:
        """Whether the fit could be simulated and has derivatives."""
        at = self.solution.at
        return at is not None and at.ok and self.solution.jacobian is not None

    @property
    def residuals(self) -> FloatArray:
        """The residuals of the other records."""
        at = self.solution.at
        assert at is not None
        return np.asarray(at.residuals)


def odd_record(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find the record that one change of a column makes consistent with all others."""
    if len(fitted.runs) < FEWEST_RECORDS:
        return ()
    odd = [each for each in _left_out(fitted) if _others_fit(fitted, each)]
    found = []
    for each in odd:
        fault = _fault(fitted, each)
        if fault is not None:
            found.append(fault)
    return tuple(found) if len(found) == 1 else ()


def _left_out(fitted: FittedRecords) -> list[LeftOut]:
    """Leave out each record and fit the others, from the estimates and maybe the start values."""
    many = len(fitted.runs) > MANY
    promised = []
    for position in _suspected(fitted) if many else range(len(fitted.runs)):
        rows = fitted.records.of_experiment(position)
        others = np.setdiff1d(np.arange(len(fitted.residuals)), rows)
        left = OrthogonalProjection(fitted.jacobian[others]).remove(fitted.residuals[others])
        promised.append((float(np.add.reduce(left**2)), position))
    chosen = sorted(position for _, position in sorted(promised)[: FEW if many else MOST_LEFT_OUT])
    known = [fitted.estimates]
    if fitted.levels(fitted.residuals, fitted.runs, fitted.noise_here).max() > GROSS:
        known.append({})
    kept = [tuple(e for p, e in enumerate(fitted.train) if p != left) for left in chosen]
    spaces = [make_space(fitted.problem, each, starts=s) for each in kept for s in known]
    solutions = iter(fitted.refit(spaces))
    pairs = iter(spaces)
    found = []
    for position in chosen:
        fits = [LeftOut(position, next(pairs), next(solutions)) for _ in known]
        fits = [fit for fit in fits if fit.is_known]
        if fits:
            found.append(min(fits, key=lambda fit: fit.solution.cost))
    return found


def _suspected(fitted: FittedRecords) -> list[int]:
    """Return the positions of the records with the largest residuals over noise."""
    levels = fitted.levels(fitted.residuals, fitted.runs, fitted.noise_here)
    return [int(position) for position in np.argsort(-levels, kind="stable")[:SUSPECTED]]


def _others(fitted: FittedRecords, left: LeftOut) -> list[Experiment]:
    return [run for p, run in enumerate(fitted.runs) if p != left.position]


def _others_fit(fitted: FittedRecords, left: LeftOut) -> bool:
    runs = _others(fitted, left)
    noise = fitted.noise(left.residuals, runs)
    return bool(np.all(fitted.levels(left.residuals, runs, noise) <= AT_NOISE))


def _fault(fitted: FittedRecords, left: LeftOut) -> RecordFault | None:
    """Return the change that corrects the record; None if it has no fault, or no change helps."""
    run, others = fitted.runs[left.position], _others(fitted, left)
    names = {o.variable for each in others for o in each.outputs}
    if not all(o.variable in names for o in run.outputs):
        return None
    estimates = left.space.estimates(left.solution.x)
    whole = make_space(fitted.problem, fitted.train, starts=estimates)
    x = whole.start
    alone = [i for i, u in enumerate(whole.unknowns) if u.experiments == (left.position,)]
    fault = None
    for _ in range(PASSES if alone else 1):
        searched = _searched(fitted, left, whole, x)
        if searched is None:
            return None
        fault, step = searched
        if fault is not None:
            break
        x = x.copy()
        x[alone] = np.clip(x[alone] + step[alone], whole.lower[alone], whole.upper[alone])
    return fault


def _searched(
    fitted: FittedRecords, left: LeftOut, whole: SearchSpace, x: FloatArray
) -> tuple[RecordFault | None, FloatArray] | None:
    """Search for the change at one point, and return the parameter step with the best change.

    None if the record cannot be simulated, or if the model fits it.
    """
    run, others = fitted.runs[left.position], _others(fitted, left)
    found = fitted.sensitivities(left.position, whole, x)
    if found is None:
        return None
    noise = fitted.noise(left.residuals, others)
    residuals, matrix = found
    own, sizes = _per_output(run, others, noise), _noise_of(run, others, noise)
    project = _projection(left, whole, matrix, own, noise_rows(others, noise))

    def level(change: FloatArray) -> float:
        rest = project(change)[: len(own)] * own
        return float(fitted.levels(rest, [run], sizes)[0])

    before = level(residuals)
    if not before > OFF:
        return None
    values = whole.physical(x)[left.position]
    record = OddRecord(run, residuals, project, _known_starts(fitted, run))
    changes = mended(record, lambda runs: fitted.simulate(runs, np.tile(values, (len(runs), 1))))
    best = min(changes, key=lambda change: change.left, default=None)
    step = project.step(residuals if best is None else best.residuals)
    return _best(run, changes, before, level), step


def _per_output(run: Experiment, others: list[Experiment], noise: FloatArray) -> FloatArray:
    """Return the noise of each residual of a record."""
    sizes = _noise_of(run, others, noise)
    parts = [np.full(len(o.times), size) for o, size in zip(run.outputs, sizes, strict=True)]
    return np.concatenate(parts)


def _noise_of(run: Experiment, others: list[Experiment], noise: FloatArray) -> FloatArray:
    """Return the noise of the outputs of one record, from the noise in the other records."""
    names = list(dict.fromkeys(o.variable for each in others for o in each.outputs))
    return np.array([noise[names.index(o.variable)] for o in run.outputs])


class _Projected:
    """Residuals of a record over the noise, without the part that parameters can explain.

    The other records restrict the parameters, so their residuals follow those of the record.
    """

    def __init__(self, matrix: FloatArray, own: FloatArray, others: FloatArray) -> None:
        self._projection = OrthogonalProjection(matrix)
        self._matrix, self._own, self._others = matrix, own, others

    def __call__(self, residuals: FloatArray) -> FloatArray:
        return self._projection.remove(np.concatenate([residuals / self._own, self._others]))

    def step(self, residuals: FloatArray) -> FloatArray:
        """Return the change of the parameters that reduces the residuals most, to first order."""
        stacked = np.concatenate([residuals / self._own, self._others])
        sizes = np.linalg.norm(self._matrix, axis=0)
        sizes[~(sizes > 0.0)] = 1.0
        found = np.linalg.lstsq(self._matrix / sizes, -stacked, rcond=1e-6)[0] / sizes
        return np.asarray(found)


def _projection(
    left: LeftOut, whole: SearchSpace, matrix: FloatArray, own: FloatArray, noise: FloatArray
) -> _Projected:
    labels = [u.label for u in left.space.unknowns]
    jacobian = np.zeros((len(noise), whole.size))
    assert left.solution.jacobian is not None
    for column, unknown in enumerate(whole.unknowns):
        if unknown.label in labels:
            jacobian[:, column] = left.solution.jacobian[:, labels.index(unknown.label)]
    stacked = np.vstack([matrix / own[:, None], jacobian / noise[:, None]])
    return _Projected(stacked, own, left.residuals / noise)


def _known_starts(fitted: FittedRecords, run: Experiment) -> tuple[tuple[str, float], ...]:
    """Return the states of a record whose initial value is not estimated, with this value."""
    description = fitted.problem.describe()
    taken = {p.target for p in fitted.problem.parameters}
    values, found = dict(run.values), []
    for state in description.states:
        variable = description.variables[state]
        start = values.get(state, variable.start)
        number = isinstance(start, (int, float)) and not isinstance(start, bool)
        if variable.settable and number and state not in taken:
            found.append((state, float(start)))  # type: ignore[arg-type]
    return tuple(found)


def _best(
    run: Experiment,
    changes: list[MendedRecord],
    before: float,
    level: Callable[[FloatArray], float],
) -> RecordFault | None:
    """Return the first (in `PLAINEST`) of the best changes, if the model then fits the record."""
    known = [c for c in changes if np.isfinite(c.left)]
    if not known:
        return None
    least = min(c.left + SAME * c.unknowns for c in known)
    faults = []
    for change in known:
        if change.left + SAME * change.unknowns > least + SAME:
            continue
        after = level(change.residuals)
        fault = None if after > AT_NOISE else as_fault(run, change, before, after)
        if fault is None:
            return None  # an equally good change is not a fault of a record
        faults.append(fault)
    faults.sort(key=lambda each: PLAINEST.index(each.kind))
    first = faults[0]
    same = (first.kind, first.variables)
    alike = [each.said for each in faults[1:] if (each.kind, each.variables) != same]
    return replace(first, others=tuple(dict.fromkeys(alike)))


def as_fault(
    run: Experiment, change: MendedRecord, before: float, after: float
) -> RecordFault | None:
    """Return a change as a fault; None if it is too small to be a fault."""
    kind, size, unit = change.kind, change.size, ""
    if change.factor == 0.0:
        return None  # a gain of 0 would remove the column, so it is not a wrong gain
    if kind in ("gain", "offset", "unit"):
        signals = run.inputs if change.sort == "inputs" else run.outputs
        values = next(s.values for s in signals if s.variable == change.variables[0])
        spread = float(np.std(values))
        factor, offset = 1.0 / change.factor, -change.offset / change.factor
        unit = as_unit(factor, offset, spread)
        small = abs(offset) < LEAST_GAIN * spread if kind == "offset" else kind == "unit"
        if not unit and (small or (kind == "gain" and abs(factor - 1.0) < LEAST_GAIN)):
            return None
        size = offset if kind == "offset" and not unit else factor
        kind = "unit" if unit else kind
        kind = "sign" if kind == "gain" and abs(factor + 1.0) <= LEAST_GAIN else kind
    return RecordFault(
        kind, run.id, change.sort, change.variables, size, before, after, unit,
        factor=change.factor, offset=change.offset,
    )  # fmt: skip
