"""Changes that may correct one record: of a column's gain, sign, offset, times or place.

Each change is a search in one number or has no number. All searches advance together, so that their
requests are simulated in one batch. A change of outputs alone needs no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.interpolate import make_interp_spline

from cluster_est.results.record_faults.fault import UNIT_FACTORS, FaultKind, Sort
from workers.messages import Experiment, FloatArray

ROUNDS = 8
GAINS = (0.25, 0.7, 1.4)
SHIFTS = (-32.0, -16.0, -8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Tried shifts of the times, in samples."""
LARGEST_SHIFT = 0.1
"""Largest shift, as a share of the record's length."""
STEP_OF_STATE = 1e-3
"""First step of an initial state, relative to its absolute value or 1, whichever is larger."""

Request = Experiment | FloatArray
"""A changed experiment to simulate, or residuals that are known without a simulation."""
Answer = FloatArray | None
Search = Generator[list[Request], list[Answer], tuple[float, FloatArray] | None]


@dataclass(frozen=True)
class MendedRecord:
    """A record with one change.

    Attributes
    ----------
    kind, sort, variables
        The kind of the change, and the changed inputs or outputs.
    factor, offset, size
        The factor and offset that correct the column, or another size of the change.
    unknowns
        Number of values that were fitted for the change.
    residuals : (n,)
        Residuals of the changed record.
    left
        Sum of squares of all records over their noise, after the projection.
    """

    kind: FaultKind
    sort: Sort
    variables: tuple[str, ...]
    factor: float
    offset: float
    size: float
    unknowns: int
    residuals: FloatArray = field(repr=False)
    left: float = np.inf


@dataclass(frozen=True)
class OddRecord:
    """A record that a fit to the other records does not predict.

    Attributes
    ----------
    run
        The experiment.
    residuals : (n,)
        Its residuals, with the parameters that fit the other records.
    project
        Divides residuals of this record by the noise, appends those of the other records, and
        removes the part that parameters can explain: (n, columns) to (all, columns).
    states
        The states with a known initial value, and this value.
    """

    run: Experiment
    residuals: FloatArray = field(repr=False)
    project: Callable[[FloatArray], FloatArray] = field(repr=False)
    states: tuple[tuple[str, float], ...] = ()

    def takes(self, residuals: FloatArray) -> bool:
        """Return whether residuals are finite and have the same number as those of the record."""
        return len(residuals) == len(self.residuals) and bool(np.isfinite(residuals).all())

    def square(self, residuals: FloatArray) -> float:
        """Return the sum of squares after the projection."""
        return float(np.add.reduce(self.project(residuals) ** 2))


def mended(
    record: OddRecord, simulate: Callable[[list[Experiment]], list[Answer]]
) -> list[MendedRecord]:
    """Return all changes of a record, each with its best size.

    Parameters
    ----------
    record
        The odd record.
    simulate
        Returns residuals of changed experiments, with the parameters that fit the other records.
    """
    entries = [*_of_outputs(record), *_of_inputs(record), *_of_start(record)]
    asked = [next(search) for _, search in entries]
    found: list[MendedRecord] = []
    waiting = list(zip(entries, asked, strict=True))
    while waiting:
        wanted = [r for _, requests in waiting for r in requests if isinstance(r, Experiment)]
        answers = iter(simulate(wanted) if wanted else [])
        still = []
        for (make, search), requests in waiting:
            own = [next(answers) if isinstance(r, Experiment) else r for r in requests]
            try:
                still.append(((make, search), search.send(own)))
            except StopIteration as end:
                if end.value is not None:
                    change: MendedRecord = make(*end.value)
                    found.append(replace(change, left=record.square(change.residuals)))
        waiting = still
    return found


Make = Callable[[float, FloatArray], MendedRecord]
Entry = tuple[Make, Search]


def _scalar(
    record: OddRecord,
    begin: float,
    sizes: Sequence[float],
    ask: Callable[[float], Request],
    *,
    near: bool = True,
) -> Search:
    """Find the best size of a change: try some sizes, then do Gauss-Newton steps with secants.

    Parameters
    ----------
    begin
        The size without a change.
    near
        Whether a step is limited to twice the distance of the neighbouring size.
    """
    known: dict[float, FloatArray] = {begin: record.residuals}
    wanted = [size for size in sizes if size not in known]
    for _ in range(ROUNDS):
        answers = yield [ask(size) for size in wanted]
        pairs = zip(wanted, answers, strict=True)
        known |= {size: each for size, each in pairs if each is not None and record.takes(each)}
        wanted = _steps(record, known, near=near)
        if not wanted:
            break
    squares = {size: record.square(residuals) for size, residuals in known.items()}
    best = min(squares, key=lambda size: squares[size])
    return None if best == begin else (best, known[best])


def _steps(record: OddRecord, known: dict[float, FloatArray], *, near: bool) -> list[float]:
    """Return the next sizes, from the secants between the best size and its two neighbours."""
    sizes = sorted(known)
    squares = [record.square(known[size]) for size in sizes]
    best = int(np.argmin(squares))
    here, low = sizes[best], record.project(known[sizes[best]])
    found = []
    for other in (best - 1, best + 1):
        if not 0 <= other < len(sizes):
            continue
        width = sizes[other] - here
        slope = (record.project(known[sizes[other]]) - low) / width
        square = float(np.add.reduce(slope**2))
        if not square > 0.0:
            continue
        step = -float(np.add.reduce(slope * low)) / square
        if near:
            step = float(np.clip(step, -2.0 * abs(width), 2.0 * abs(width)))
        if abs(step) > 1e-4 * abs(width) and here + step not in known:
            found.append(here + step)
    return found


def _of_outputs(record: OddRecord) -> list[Entry]:
    """Return the changes of outputs; these need no simulation."""
    entries: list[Entry] = []
    run, names = record.run, [o.variable for o in record.run.outputs if len(o.times)]
    for name in names:
        entries.append(_gain_of_output(record, name))
        rows, sigmas, measured, simulated = _parts(record, name)
        turned = _with_rows(record, rows, (-measured - simulated) / sigmas)
        entries.append(_as_it_is(turned, "sign", "outputs", (name,), -1.0))
        entries.append(_offset_of_output(record, name))
        entries.append(_units_of_output(record, name))
        entries += [_late(record, (name,), "delay", smooth=smooth) for smooth in (True, False)]
    if len(names) > 1:
        both = tuple(names)
        entries += [_late(record, both, "clock", smooth=smooth) for smooth in (True, False)]
    for one, other in combinations(names, 2):
        first, second = (next(o for o in run.outputs if o.variable == n) for n in (one, other))
        if np.array_equal(first.times, second.times):
            entries.append(_swapped_outputs(record, one, other))
    return entries


def _rows(record: OddRecord, name: str) -> slice:
    first = 0
    for output in record.run.outputs:
        if output.variable == name:
            return slice(first, first + len(output.times))
        first += len(output.times)
    raise KeyError(name)


def _with_rows(record: OddRecord, rows: slice, values: FloatArray) -> FloatArray:
    residuals = record.residuals.copy()
    residuals[rows] = values
    return residuals


def _parts(record: OddRecord, name: str) -> tuple[slice, FloatArray, FloatArray, FloatArray]:
    """Return the rows, sigmas, measured and simulated values of an output."""
    rows = _rows(record, name)
    output = next(o for o in record.run.outputs if o.variable == name)
    sigmas = output.sigmas
    return rows, sigmas, output.values, output.values - sigmas * record.residuals[rows]


def _gain_of_output(record: OddRecord, name: str) -> Entry:
    rows, sigmas, measured, simulated = _parts(record, name)

    def ask(factor: float) -> FloatArray:
        return _with_rows(record, rows, (factor * measured - simulated) / sigmas)

    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord("gain", "outputs", (name,), size, 0.0, np.nan, 1, residuals)

    return make, _scalar(record, 1.0, (0.5,), ask, near=False)


def _offset_of_output(record: OddRecord, name: str) -> Entry:
    rows, sigmas, measured, simulated = _parts(record, name)
    unit = float(np.std(measured)) or 1.0

    def ask(size: float) -> FloatArray:
        return _with_rows(record, rows, (measured + size * unit - simulated) / sigmas)

    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord("offset", "outputs", (name,), 1.0, size * unit, np.nan, 1, residuals)

    return make, _scalar(record, 0.0, (1.0,), ask, near=False)


def _units_of_output(record: OddRecord, name: str) -> Entry:
    """Return the change of an output's unit: the best of the possible units."""
    rows, sigmas, measured, simulated = _parts(record, name)
    return _units(
        record, "outputs", name,
        lambda factor, offset: _with_rows(
            record, rows, (factor * measured + offset - simulated) / sigmas
        ),
    )  # fmt: skip


def _units(
    record: OddRecord, sort: Sort, name: str, ask: Callable[[float, float], Request]
) -> Entry:
    ways = conversions()

    def search() -> Search:
        answers = yield [ask(*way) for way in ways]
        known = [
            (record.square(answer), number, answer)
            for number, answer in enumerate(answers)
            if answer is not None and record.takes(answer)
        ]
        if not known:
            return None
        _, number, residuals = min(known, key=lambda each: each[:2])
        return float(number), residuals

    def make(number: float, residuals: FloatArray) -> MendedRecord:
        factor, offset = ways[int(number)]
        return MendedRecord("unit", sort, (name,), factor, offset, np.nan, 0, residuals)

    return make, search()


def conversions() -> list[tuple[float, float]]:
    """Return factors and offsets that convert a column from another unit into the right one."""
    there = [(1.0 / factor, -offset / factor) for factor, offset, _ in UNIT_FACTORS]
    back = [(factor, offset) for factor, offset, _ in UNIT_FACTORS]
    return [*there, *back]


def _late(record: OddRecord, names: tuple[str, ...], kind: FaultKind, *, smooth: bool) -> Entry:
    """Return the shift of outputs in time; samples outside the simulated time are ignored.

    `smooth` says whether the simulated outputs are smooth between samples, or have kinks like the
    inputs.
    """
    own = [(o, *_parts(record, o.variable)) for o in record.run.outputs if o.variable in names]
    own = [each for each in own if len(each[0].times) > 3]
    courses = [
        make_interp_spline(o.times, simulated, 3 if smooth else 1) for o, _, _, _, simulated in own
    ]
    step = max((float(np.median(np.diff(o.times))) for o, *_ in own), default=1.0)
    most = LARGEST_SHIFT * (record.run.stop - record.run.start)

    def ask(late: float) -> FloatArray:
        residuals = record.residuals.copy()
        for (output, rows, sigmas, measured, _), course in zip(own, courses, strict=True):
            at = output.times - late * step
            inside = (at >= output.times[0]) & (at <= output.times[-1])
            residuals[rows] = np.where(inside, (measured - course(at)) / sigmas, 0.0)
        return residuals

    def make(late: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord(kind, "outputs", names, 1.0, 0.0, late * step, 1, residuals)

    return make, _scalar(record, 0.0, [s for s in SHIFTS if abs(s) * step <= most], ask)


def _swapped_outputs(record: OddRecord, one: str, other: str) -> Entry:
    first, sigmas, measured, simulated = _parts(record, one)
    second, other_sigmas, other_measured, other_simulated = _parts(record, other)
    changed = _with_rows(record, first, (other_measured - simulated) / sigmas)
    changed[second] = (measured - other_simulated) / other_sigmas
    return _as_it_is(changed, "swapped", "outputs", (one, other))


def _as_it_is(
    change: Request, kind: FaultKind, sort: Sort, names: tuple[str, ...], factor: float = 1.0
) -> Entry:
    def search() -> Search:
        (answer,) = yield [change]
        return None if answer is None or not np.isfinite(answer).all() else (np.nan, answer)

    def make(_: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord(kind, sort, names, factor, 0.0, factor, 0, residuals)

    return make, search()


def _of_inputs(record: OddRecord) -> list[Entry]:
    """Return the changes of inputs; each of them needs simulations."""
    run = record.run
    entries: list[Entry] = []
    for given in run.inputs:
        if np.ptp(given.values) > 0.0:
            entries.append(_gain_of_input(record, given.variable))
            turned = with_input(run, given.variable, -1.0)
            entries.append(_as_it_is(turned, "sign", "inputs", (given.variable,), -1.0))
            entries.append(_late_input(record, given.variable))
        entries.append(_offset_of_input(record, given.variable))
        entries.append(_units_of_input(record, given.variable))
    for one, other in combinations(run.inputs, 2):
        places = {one.variable: other, other.variable: one}
        inputs = tuple(
            replace(i, times=places[i.variable].times, values=places[i.variable].values)
            if i.variable in places
            else i
            for i in run.inputs
        )
        changed = replace(run, inputs=inputs)
        entries.append(_as_it_is(changed, "swapped", "inputs", (one.variable, other.variable)))
    return entries


def _units_of_input(record: OddRecord, name: str) -> Entry:
    return _units(
        record, "inputs", name, lambda factor, offset: with_input(record.run, name, factor, offset)
    )


def with_input(
    run: Experiment, name: str, factor: float = 1.0, offset: float = 0.0, earlier: float = 0.0
) -> Experiment:
    """Return an experiment with one of its inputs multiplied, shifted and moved in time."""
    inputs = tuple(
        replace(i, times=i.times - earlier, values=factor * i.values + offset)
        if i.variable == name
        else i
        for i in run.inputs
    )
    return replace(run, inputs=inputs)


def stretched(run: Experiment, factor: float) -> Experiment:
    """Return an experiment with its times multiplied by a factor."""
    return replace(
        run,
        start=run.start * factor,
        stop=run.stop * factor,
        inputs=tuple(replace(i, times=i.times * factor) for i in run.inputs),
        outputs=tuple(replace(o, times=o.times * factor, reference=None) for o in run.outputs),
        signals=tuple(replace(s, times=s.times * factor) for s in run.signals),
        bounds=(),
        curve=None,
        cost_function=None,
        constraint_functions=(),
    )


def _gain_of_input(record: OddRecord, name: str) -> Entry:
    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord("gain", "inputs", (name,), size, 0.0, np.nan, 1, residuals)

    return make, _scalar(record, 1.0, GAINS, lambda size: with_input(record.run, name, size))


def _offset_of_input(record: OddRecord, name: str) -> Entry:
    given = next(i for i in record.run.inputs if i.variable == name)
    unit = float(np.std(given.values)) or max(abs(float(given.values[0])), 1.0)

    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord("offset", "inputs", (name,), 1.0, size * unit, np.nan, 1, residuals)

    def ask(size: float) -> Experiment:
        return with_input(record.run, name, 1.0, size * unit)

    return make, _scalar(record, 0.0, (-0.5, 0.5), ask)


def _late_input(record: OddRecord, name: str) -> Entry:
    given = next(i for i in record.run.inputs if i.variable == name)
    step = float(np.median(np.diff(given.times))) if len(given.times) > 1 else 1.0
    most = LARGEST_SHIFT * (record.run.stop - record.run.start)

    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord("delay", "inputs", (name,), 1.0, 0.0, size * step, 1, residuals)

    def ask(size: float) -> Experiment:
        return with_input(record.run, name, earlier=size * step)

    return make, _scalar(record, 0.0, [s for s in SHIFTS if abs(s) * step <= most], ask)


def _of_start(record: OddRecord) -> list[Entry]:
    """Return the changes of known initial states, one at a time."""
    return [_start_of(record, state, start) for state, start in record.states]


def _start_of(record: OddRecord, state: str, start: float) -> Entry:
    def make(size: float, residuals: FloatArray) -> MendedRecord:
        return MendedRecord(
            "initial state", "outputs", (state,), 1.0, start + size, size, 1, residuals
        )

    def ask(size: float) -> Experiment:
        values = {**dict(record.run.values), state: start + size}
        return replace(record.run, values=tuple(values.items()))

    unit = STEP_OF_STATE * max(abs(start), 1.0)
    return make, _scalar(record, 0.0, (-unit, unit), ask, near=False)
