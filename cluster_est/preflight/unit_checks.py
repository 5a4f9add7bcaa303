"""Checks of units: columns, signals and times whose unit seems to differ from the model's.

The name of a column may contain its unit. Otherwise the evidence is an error: with the other unit,
the data must be close to the simulation at the start values, and far from it without. Start values
that are far off give no evidence, and no warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.config.sections import Config
from cluster_est.preflight.subject import (
    CheckFinding,
    CheckSubject,
    fault,
    note,
    unanswered,
)
from cluster_est.preflight.table_column import split_suffix
from cluster_est.problem.tables.sources import TableSource
from cluster_est.problem.tables.units import (
    UnitConversion,
    conversion,
    likely_conversions,
    same_unit,
    split_unit,
)
from cluster_est.results.output_errors import Simulation
from cluster_est.results.record_faults.changes import stretched
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Input
from workers.probes.other_simulations import SimulatedVariant, VariantProbe
from workers.process.trial import NoAnswer

LEAST_LETTERS = 2
"""Smallest number of letters of a unit at the end of a name: "x_m" may be a measured x."""


def unit_findings(
    config: Config, description: ModelDescription, tables: Sequence[TableSource] = ()
) -> list[CheckFinding]:
    """Return a finding for each column whose name or file gives another unit than its variable's.

    The unit is in the name, in a row below the header, or in the metadata of a channel. Each column
    is reported once for all experiments. Columns with an entry under `columns` in the config, or
    with an unknown unit, are omitted, and so are times since 1970, whose unit is found by their
    size.
    """
    dated = {each.experiment for each in tables if each.dated}
    said = {(each.experiment, name): unit for each in tables for name, unit in each.units}
    pairs = dict.fromkeys(
        (*pair, said.get((experiment.id, pair[1] or ""), ""))
        for experiment in config.experiments
        for pair in [
            ("time", "" if experiment.id in dated else experiment.time),
            *((name, each.column) for name, each in experiment.inputs.items()),
            *((name, each.column) for name, each in experiment.outputs.items()),
        ]
        if pair[1] not in experiment.columns
    )
    lines = []
    for variable, named, beside in pairs:
        found, column = description.variables.get(variable), named or ""
        wanted = "s" if found is None else found.unit
        unit = _unit(column, wanted) or beside
        change = conversion(unit, wanted) if unit and wanted else None
        if change is None or change == UnitConversion(1.0) or same_unit(unit, wanted):
            continue
        shown = f"'{column}'" if split_unit(column)[1] == unit else f"'{column}' in {unit}"
        line = f"column {shown} is used for {variable}, which is in {wanted}, without a conversion"
        do = f"set {dotted('columns', column)} = {{ factor = {change.factor:.12g}, "
        do += (
            f"offset = {change.offset:.12g} }}; if only the unit in the name is wrong, set only "
            "factor = 1"
        )
        lines.append(fault("units", line, do))
    return lines


def _unit(column: str, wanted: str) -> str:
    """Return the unit in a column's name; at its end, only a unit that is hardly a word."""
    unit = split_unit(column)[1]
    found = None if unit or not wanted else split_suffix(column, wanted)
    return unit if found is None or len(found[1]) < LEAST_LETTERS else found[1]


MISFIT_AS_READ, MISFIT_CONVERTED = 0.7, 0.5
"""Errors relative to the signal's spread: smallest as read, and largest in the other unit."""
REMAINING_MISFIT = 0.5
"""Largest share of the error that may remain in the other unit."""
NAMELESS = {
    "rpm": ("rad/s", UnitConversion(np.pi / 30.0)),
    "rad/s": ("rpm", UnitConversion(30.0 / np.pi)),
    "deg": ("rad", UnitConversion(np.pi / 180.0)),
    "rad": ("deg", UnitConversion(180.0 / np.pi)),
}
"""Units to try for variables without a unit in the FMU: unit, the model's, conversion."""
KELVINS = 25.0
"""Largest error of a start in kelvins when an offset of 273.15 K is tested."""
RECORD_OVER_EXPERIMENT, SMOOTH, ALIKE = 20.0, 0.5, 1.6
"""Criteria for a time in milliseconds: smallest ratio of the record to the FMU's own experiment;
changes between samples over the spread, and the factor within which two changes are similar."""
TIME_UNIT_SECONDS = {"milliseconds": 1e-3, "minutes": 60.0, "hours": 3600.0}


@dataclass(frozen=True)
class _Reading:
    """A way to read a signal: its unit, the model's unit, and the conversion."""

    unit: str
    wanted: str
    change: UnitConversion

    def of(self, values: FloatArray) -> FloatArray:
        return values * self.change.factor + self.change.offset


def misread_units(subject: CheckSubject, simulations: Sequence[Simulation]) -> list[CheckFinding]:
    """Look for outputs, then for an input, then for times in another unit."""
    if not subject.declared or subject.problem.effects:
        return []
    return _outputs(subject, simulations) or _inputs(subject, simulations)


def _outputs(subject: CheckSubject, simulations: Sequence[Simulation]) -> list[CheckFinding]:
    """Return a finding for each output whose measured and simulated sizes differ by a unit."""
    pairs: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for each in simulations:
        if each.outcome.trajectory is None:
            continue
        seen = each.outcome.trajectory
        table = SimulatedVariant(seen.times, seen.values)
        experiment = subject.problem.experiments[each.experiment]
        for name, pair in _pairs(experiment, table, seen.variables).items():
            pairs.setdefault(name, []).append(pair)
    lines = []
    for name, both in pairs.items():
        measured = np.concatenate([one for one, _ in both])
        simulated = np.concatenate([other for _, other in both])
        found = _likelier(measured, simulated, _readings(subject, name))
        if found is not None:
            lines.append(_output_line(name, measured, simulated, found))
    return lines


def _output_line(
    name: str, measured: FloatArray, simulated: FloatArray, found: _Reading
) -> CheckFinding:
    change = found.change
    if change.offset:
        said = (
            f"the measured values are around {np.mean(measured):.3g}, but the simulated values are "
            f"around {np.mean(simulated):.3g}, and {found.unit} and {found.wanted} differ by as "
            "much"
        )
    else:
        ratio = _size(measured) / _size(simulated)
        said = (
            f"the measured values are {ratio:.3g} times as large as the simulated values, and 1 "
            f"{found.wanted} is {1.0 / change.factor:.4g} {found.unit}"
        )
    said += f"; so the column seems to be in {found.unit}"
    return note(f"unit of {name}", said, _column(change))


def _column(change: UnitConversion) -> str:
    offset = f", offset = {change.offset:.12g}" if change.offset else ""
    return (
        f"write columns.COLUMN = {{ factor = {change.factor:.12g}{offset} }}, with the name of the "
        "column"
    )


def _readings(subject: CheckSubject, name: str) -> list[_Reading]:
    """Return the possible units of the column of a variable."""
    unit = subject.description.variables[name].unit
    if unit:
        likely = likely_conversions(unit)
        return [_Reading(other, unit, change) for other, change in likely.items()]
    return [_Reading(other, wanted, change) for other, (wanted, change) in NAMELESS.items()]


def _likelier(
    measured: FloatArray, simulated: FloatArray, readings: Sequence[_Reading]
) -> _Reading | None:
    """Return the reading with which the data fit the simulation; None if none clearly does."""
    as_is = _error(measured, simulated)
    if not as_is > MISFIT_AS_READ:
        return None
    errors = []
    for i, reading in enumerate(readings):
        read = reading.of(measured)
        if reading.change.offset:
            nearer = abs(float(np.mean(read - simulated))) < KELVINS
            farther = abs(float(np.mean(measured - simulated))) > 4.0 * KELVINS
            clear = nearer and farther
            errors.append((0.0 if clear else np.inf, i))
        else:
            errors.append((_error(read, simulated), i))
    error, i = min(errors, default=(np.inf, 0))
    return readings[i] if error < min(MISFIT_CONVERTED, REMAINING_MISFIT * as_is) else None


def _error(measured: FloatArray, simulated: FloatArray) -> float:
    """Return the error over the measured spread; NaN for a constant signal."""
    spread = float(np.std(measured))
    if len(measured) < 3 or not spread > 0.0:
        return float("nan")
    return float(np.sqrt(np.mean((measured - simulated) ** 2))) / spread


def _size(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) or np.nan


def _pairs(
    experiment: Experiment, table: SimulatedVariant, variables: Sequence[str]
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the measured and simulated values of each output without a free scale or offset."""
    found = {}
    for output in experiment.outputs:
        if output.learns:
            continue
        rows = np.searchsorted(table.times, output.times)
        column = list(variables).index(output.variable)
        found[output.variable] = output.values, table.values[rows, column]
    return found


@dataclass(frozen=True)
class _Variant:
    """An experiment with another interpretation of its data."""

    experiment: Experiment
    factor: float
    said: str
    do: str
    check: str


def _inputs(subject: CheckSubject, simulations: Sequence[Simulation]) -> list[CheckFinding]:
    """Return a finding on an input, or on the time, if the data fit with another unit."""
    index = subject.experiment
    mine = next((s for s in simulations if s.experiment == index), None)
    experiment = subject.problem.experiments[index]
    seen = None if mine is None else mine.outcome.trajectory
    as_is = np.inf
    if seen is not None:
        as_is = _joint(experiment, SimulatedVariant(seen.times, seen.values), seen.variables)
    variants = [*_input_variants(subject, experiment), *_time_variants(subject, experiment)]
    if not as_is > MISFIT_AS_READ or not variants:
        return []
    tried = tuple((v.experiment, v.factor) for v in variants)
    probe = VariantProbe(tried, subject.start, subject.reset_policy, subject.budget.left / 3.0)
    found = subject.ask(probe, len(tried), subject.budget.left / 2.0)
    if isinstance(found, NoAnswer):
        return [unanswered("units", found)] if found.late else []
    errors = [
        np.inf if table is None else _joint(v.experiment, table, v.experiment.recorded)
        for v, table in zip(variants, found, strict=False)
    ]
    best = int(np.argmin(errors)) if errors else 0
    if errors and errors[best] < min(MISFIT_CONVERTED, REMAINING_MISFIT * as_is):
        chosen = variants[best]
        far = f", instead of {as_is:.2g}" if np.isfinite(as_is) else ""
        said = f"{chosen.said}; if so, the error at the start values is {errors[best]:.2g} of "
        said += f"the outputs' spread{far}"
        return [note(chosen.check, said, chosen.do)]
    before = None if seen is None else SimulatedVariant(seen.times, seen.values)
    return _jumpy(subject, before, list(zip(variants, found, strict=False)))


def _jumpy(
    subject: CheckSubject,
    before: SimulatedVariant | None,
    tried: Sequence[tuple[_Variant, SimulatedVariant | None]],
) -> list[CheckFinding]:
    """Return a finding if the simulation, but not the data, jumps from sample to sample.

    This is for an oscillating model, whose phase at the start values is arbitrary. The record must
    be much longer than the FMU's own experiment, and its times must be integers. With times in
    milliseconds, the simulation must change between samples as much as the data do.
    """
    experiment = subject.problem.experiments[subject.experiment]
    start, stop = subject.description.default_start or 0.0, subject.description.default_stop
    long = experiment.stop - experiment.start
    whole = all(np.allclose(o.times, np.round(o.times), 0.0, 1e-6) for o in experiment.outputs)
    if stop is None or not whole or not long > RECORD_OVER_EXPERIMENT * (stop - start):
        return []
    wanted, variables = _steps(experiment, None), experiment.recorded
    as_is = np.inf if before is None else _steps(experiment, before, variables)
    for variant, table in tried:
        if variant.factor < 1.0 and table is not None and wanted < SMOOTH:
            found = _steps(variant.experiment, table, variables)
            if as_is > 2.0 * wanted and wanted / ALIKE < found < wanted * ALIKE:
                said = (
                    f"{variant.said}, and the FMU's own experiment lasts {stop - start:.4g} s; "
                    "only with times in that unit does the simulation change from sample to sample "
                    "as the data do"
                )
                return [note(variant.check, said, variant.do)]
    return []


def _steps(
    experiment: Experiment, table: SimulatedVariant | None, variables: Sequence[str] = ()
) -> float:
    """Return the changes of signals between samples, relative to their spread."""
    signals = [output.values for output in experiment.outputs if not output.learns]
    if table is not None:
        signals = [pair[1] for pair in _pairs(experiment, table, variables).values()]
    found = [
        float(np.sqrt(np.mean(np.diff(each) ** 2)) / np.std(each))
        for each in signals
        if len(each) > 2 and np.std(each) > 0.0
    ]
    return max(found, default=float("nan"))


def _input_variants(subject: CheckSubject, experiment: Experiment) -> Iterator[_Variant]:
    for given in experiment.inputs:
        for reading in _readings(subject, given.variable):
            read = replace(given, values=reading.of(given.values))
            yield _Variant(
                _with_input(experiment, read),
                1.0,
                f"the column seems to be in {reading.unit}, but the FMU uses {reading.wanted}",
                _column(reading.change),
                f"unit of {given.variable}",
            )


def _with_input(experiment: Experiment, given: Input) -> Experiment:
    others = tuple(given if i.variable == given.variable else i for i in experiment.inputs)
    return replace(experiment, inputs=others)


def _time_variants(subject: CheckSubject, experiment: Experiment) -> Iterator[_Variant]:
    long = experiment.stop - experiment.start
    tables = {table.experiment: table for table in subject.problem.tables}
    table = tables.get(experiment.id)
    for unit, factor in TIME_UNIT_SECONDS.items():
        yield _Variant(
            stretched(experiment, factor),
            factor,
            f"the times seem to be in {unit}, but are read as seconds, so the experiment lasts "
            f"{long:.4g} s",
            _rescaled_time(table, factor),
            "time",
        )


def _rescaled_time(table: TableSource | None, factor: float) -> str:
    """Return the key for the unit of a table's times."""
    if table is not None and table.time:
        return f"write {dotted('columns', table.time)} = {{ factor = {factor:g} }}"
    if table is not None and table.sample_time:
        return f"write sample_time = {table.sample_time * factor:g}"
    return (
        f"write columns.COLUMN = {{ factor = {factor:g} }}, with the name of the time column, or "
        f"multiply sample_time by {factor:g}"
    )


def _joint(experiment: Experiment, table: SimulatedVariant, variables: Sequence[str]) -> float:
    """Return the root mean square of the errors of all changing outputs."""
    errors = [_error(*pair) for pair in _pairs(experiment, table, variables).values()]
    known = [error for error in errors if not np.isnan(error)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else float("nan")
