"""The contents of a first config, before it is written: parameters, bounds, experiments."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from cluster_est.errors import DataError, ModelError
from cluster_est.preflight.column_matches import ColumnMatch, has_unit, match, same
from cluster_est.preflight.draft_sources import DraftSource, KnownParameter, sources
from cluster_est.preflight.files_of_tests import with_joined_files
from cluster_est.preflight.table_column import TableColumn
from cluster_est.preflight.table_columns import TableColumns, read_columns
from cluster_est.problem.tables.measured_table import MOST_NAMED_COLUMNS, Reading
from cluster_est.problem.tables.units import conversion, split_unit
from workers.fmu.description import ModelDescription, describe, nearest
from workers.fmu.variable import ModelVariable
from workers.messages import Role

TIME_NAME = "time"
"""Name that means the time, whatever its name in the FMU."""


def check_variables(mapping: Mapping[str, str], description: ModelDescription) -> None:
    """Refuse names that are not variables, and variables that cannot have a column.

    Raises
    ------
    ModelError
        With the most similar name.
    """
    measurable = [v.name for v in description.variables.values() if v.is_computed]
    inputs = [v.name for v in description.inputs()]
    for name in mapping:
        if name == TIME_NAME:
            continue
        if name not in description.variables:
            known = nearest(name, [TIME_NAME, *inputs, *description.outputs, *measurable])
            raise ModelError(f"--map {name}: {description.file} has no variable {name!r}{known}")
        if name not in inputs and name not in measurable:
            variable = description.variables[name]
            what = variable.causality if variable.kind != "string" else "text"
            raise ModelError(
                f"--map {name}: must be an input or a computed variable of {description.file}, but "
                f"is a {what}; give the column to another variable"
            )


def check_columns(mapping: Mapping[str, str], tables: Sequence[TableColumns]) -> None:
    """Refuse a column that no table has.

    Raises
    ------
    DataError
        With the most similar column and all others.
    """
    for name, column in mapping.items():
        if any(column in table.named for table in tables):
            continue
        first = tables[0]
        if column in first.unusable:
            raise DataError(
                f"--map {name}: column {column!r} of {first.path} must hold numbers, but does not; "
                "correct it, or give another column"
            )
        names = [*first.named]
        found = nearest(column, names)
        if found.endswith("?"):
            listed = ", ".join(repr(each) for each in names[:MOST_NAMED_COLUMNS])
            more = len(names) - MOST_NAMED_COLUMNS
            found += f" Its columns are {listed}" + (f" and {more} more" if more > 0 else "")
        raise DataError(f"--map {name}: {first.path} has no column {column!r}{found}")


@dataclass(frozen=True)
class DraftExperiment:
    """A measured table as an experiment.

    Attributes
    ----------
    id, columns, role
        Id, columns and role of the experiment.
    inputs, outputs
        The variables of the FMU, and the columns found for them.
    further
        Other variables of the FMU that have a column with their name.
    test
        (column, value) of a test in its table; the value is "" if it represents several tests.
    lines
        Lines of the config that follow from the origin of the table.
    """

    id: str
    columns: TableColumns
    role: Role
    inputs: tuple[ColumnMatch, ...]
    outputs: tuple[ColumnMatch, ...]
    further: tuple[ColumnMatch, ...]
    test: tuple[str, str] | None = None
    lines: tuple[str, ...] = ()

    @property
    def used(self) -> tuple[TableColumn, ...]:
        """The columns of its variables, including those to be confirmed."""
        every = (*self.inputs, *self.outputs, *self.further)
        return tuple(c for m in every for c in (m.column, m.similar) if c is not None)

    @property
    def stand_ins(self) -> tuple[float, ...]:
        """Numbers in these columns that probably mark missing measurements, each once."""
        return tuple(sorted({value for column in self.used for value in column.stand_ins}))

    @property
    def switches(self) -> tuple[tuple[ModelVariable, str], ...]:
        """Inputs with a unit whose column is on or off, and the names of these columns."""
        pairs = [(m.variable, m.column or m.similar) for m in self.inputs]
        return tuple((v, c.name) for v, c in pairs if c is not None and c.is_switch and has_unit(v))

    @property
    def missing_inputs(self) -> tuple[str, ...]:
        """Names of inputs without a similar column."""
        return tuple(m.variable.name for m in self.inputs if m.column is None and not m.similar)


@dataclass(frozen=True)
class ConfigDraft:
    """The contents of a first config."""

    fmu: Path
    description: ModelDescription
    parameters: tuple[ParameterCandidate, ...]
    states: tuple[ModelVariable, ...]
    runs: tuple[DraftExperiment, ...]
    values: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def draft(
    fmu: Path,
    data: Sequence[Path],
    mapping: Mapping[str, str] | None = None,
    reading: Reading | None = None,
    missing: tuple[float, ...] = (),
) -> ConfigDraft:
    """Draft a config from an FMU and measured tables.

    Parameters
    ----------
    fmu
        Path of the FMU.
    data
        Tables, one for each experiment; the last of several is held out. Or one folder of tables.
        Empty for the FMU's own reference results.
    mapping
        Columns of variables of the FMU, or of "time".
    reading
        Known options for reading the tables.
    missing
        Numbers in the tables that mark missing measurements.

    Raises
    ------
    ModelError, DataError
        If a file cannot be read, or is named twice, or if the mapping contains unknown names.
    """
    known = {} if mapping is None else mapping
    _check_once(data)
    if not fmu.is_file():
        raise ModelError(f"init: there is no FMU {fmu}; check the path")
    try:
        archive = fmu.read_bytes()
    except OSError as error:
        raise ModelError(
            f"init: {fmu} cannot be read ({error.strerror}); check the path and its permissions"
        ) from error
    description = describe(fmu.name, archive)
    check_variables(known, description)
    found = sources(fmu, data, Reading() if reading is None else reading)
    known = {n: c for n, c in found.mapping.items() if n in description.variables} | {**known}
    read = _tables(found.tables, known.get(TIME_NAME, ""), missing)
    joined, notes = with_joined_files(read, missing)
    tables = _alike(joined)
    check_columns(known, [columns for _, columns in tables])
    held_out = len(tables) - 1 if len(tables) > 1 else -1
    runs: list[DraftExperiment] = []
    ids = _ids([source.id or source.path.stem for source, _ in tables])
    for i, ((source, columns), name) in enumerate(zip(tables, ids, strict=True)):
        role: Role = "test" if i == held_out else "train"
        run = _run(name, columns, role, description, known)
        run = replace(run, test=source.test, lines=source.lines)
        alone = len(tables) == 1
        runs += _of_tests(run, alone=alone) if columns.tests and not source.test else [run]
    given = found.parameters
    return ConfigDraft(
        fmu,
        description,
        tuple(_with_known(each, given) for each in candidates(description)),
        tuple(initial_states(description)),
        tuple(runs),
        {n: each.start for n, each in given.items() if not each.estimate},
        notes,
    )


def _tables(
    given: Sequence[DraftSource], time: str, missing: tuple[float, ...]
) -> list[tuple[DraftSource, TableColumns]]:
    """Return the columns of each source; a file with several tests is read once."""
    read: dict[tuple[Path, Reading], TableColumns] = {}
    for each in given:
        if (each.path, each.reading) not in read:
            read[each.path, each.reading] = read_columns(each.path, time, each.reading, missing)
    return [(each, read[each.path, each.reading]) for each in given]


def _alike(
    tables: Sequence[tuple[DraftSource, TableColumns]],
) -> list[tuple[DraftSource, TableColumns]]:
    """Mark a column with few values as recorded at changes, if it is so in another file."""
    marked = {column.name for _, each in tables for column in each.signals if column.at_changes}

    def alike(columns: TableColumns) -> TableColumns:
        signals = [replace(c, at_changes=c.few and c.name in marked) for c in columns.signals]
        return replace(columns, signals=tuple(signals))

    return [(source, alike(columns)) for source, columns in tables]


def _of_tests(run: DraftExperiment, *, alone: bool) -> list[DraftExperiment]:
    """Return an entry for all tests of a file, and one for the held-out last test."""
    columns, name = run.columns, "*" if alone else f"{run.id} *"
    last = columns.tests[-1]
    several = replace(run, id=name, test=(columns.split_by, ""))
    if not alone:
        return [several]
    held = replace(run, id=last, role="test", test=(columns.split_by, last))
    return [several, held]


def _with_known(
    candidate: ParameterCandidate, known: Mapping[str, KnownParameter]
) -> ParameterCandidate:
    """Return a parameter with values from a folder of tables, which may exclude its estimation."""
    if not known:
        return candidate
    given = known.get(candidate.variable.name)
    if given is None or not given.estimate:
        return replace(candidate, why_not="the folder's parameters say that it is not estimated")
    bounds = given.bounds or candidate.bounds
    return replace(
        candidate,
        start=given.start,
        bounds=bounds,
        origin="from the folder's parameters",
        why_not="",
        scale=given.scale,
    )


def _run(
    name: str,
    columns: TableColumns,
    role: Role,
    description: ModelDescription,
    mapping: Mapping[str, str],
) -> DraftExperiment:
    known = {
        v: columns.named[c] for v, c in mapping.items() if v != TIME_NAME and c in columns.named
    }
    inputs = [v for v in description.inputs() if v.kind in ("real", "integer", "boolean")]
    outputs = [description.variables[n] for n in description.outputs]
    numbers = [v for v in outputs if v.kind in ("real", "integer", "boolean")]
    own = {v.name for v in (*inputs, *numbers)}
    asked = [description.variables[name] for name in known if name not in own]
    taken = {column.name for column in known.values()}
    free = [column for column in columns.signals if column.name not in taken]
    others = [v for v in description.variables.values() if _computed(v) and v.name not in own]
    named = {column.name for column in same([*asked, *others], free).values()}
    together = match([*inputs, *numbers], free, known, named)
    given = {each.name for m in together for each in (m.column, m.similar) if each is not None}
    left = [column for column in free if column.name not in given]
    _refuse_spoiled([m.variable for m in together if m.column is None], columns)
    further = [
        ColumnMatch(description.variables[n], column)
        for n, column in same([*asked, *(v for v in others if v not in asked)], left, known).items()
    ]
    return DraftExperiment(
        name,
        columns,
        role,
        tuple(together[: len(inputs)]),
        tuple(together[len(inputs) :]),
        tuple(further),
    )


def _refuse_spoiled(variables: Sequence[ModelVariable], columns: TableColumns) -> None:
    """Refuse a table in which the column of a variable contains values that are not numbers."""
    spoiled = [TableColumn(name, *split_unit(name)) for name in columns.refused]
    for column in same(variables, spoiled).values():
        raise DataError(columns.refused[column.name])


def _computed(variable: ModelVariable) -> bool:
    return variable.causality == "local" and variable.kind == "real" and variable.alias_of is None


def _check_once(data: Sequence[Path]) -> None:
    counts = Counter(path.resolve() for path in data)
    repeated = [path for path in data if counts[path.resolve()] > 1]
    if repeated:
        raise DataError(
            f"init: {repeated[0]} must be named once, but is named {counts[repeated[0].resolve()]} "
            "times; remove one, because the same measurements would count twice"
        )


def _ids(stems: Sequence[str]) -> list[str]:
    """Return names, with a number if several are equal."""
    found: list[str] = []
    for stem in stems:
        name, number = stem, 2
        while name in found or (name != stem and name in stems):
            name, number = f"{stem}_{number}", number + 1
        found.append(name)
    return found


MOST_ACTIVE = 6
"""Number of parameters estimated in a first config; a few tables seldom determine more."""
MOST_LISTED_VARIABLES = 60
GUESSED_BOUND_FACTOR = 10.0
"""Guessed bounds are the start divided and multiplied by this factor."""

_CONSTANTS = {
    "g": "m/s2", "gravity": "m/s2", "pi": "1", "e": "1", "R_gas": "J/(mol.K)", "c_light": "m/s",
    "k_B": "J/K", "sigma_SB": "W/(m2.K4)", "T_ref": "K", "p_ref": "Pa",
}  # fmt: skip
"""Constants of nature and reference values, each with a unit to which theirs is convertible."""
_SETTINGS = re.compile(
    r"(?i)(^|[._])(eps\w*|tol\w*|\w*_small|\w*_nominal|sample\w*|n_\w+|use_\w+|delay_buffer)$"
)
_SPECIFIC_HEAT = re.compile(r"k?J/(\(kg[.* ]?(K|degC)\)|kg/(K|degC)|kg[.](K|degC))")
_INITIAL = re.compile(r"(?i)(^|[._])(\w*_init(ial)?|\w*_start|x0|v0)$")
_KELVINS = 50.0
"""Guessed bounds of a temperature are the start minus and plus this number of kelvins."""


@dataclass(frozen=True)
class ParameterCandidate:
    """A parameter that could be estimated.

    Attributes
    ----------
    bounds
        Lower and upper bound; None if they are unknown and cannot be guessed.
    origin
        The origin of the bounds, for a comment.
    why_not
        The reason why it is not estimated at first; "" if it is.
    per
        "experiment" if each experiment probably has its own value; otherwise "".
    scale
        "linear" or "log".
    """

    variable: ModelVariable
    start: float
    bounds: tuple[float, float] | None
    origin: str
    why_not: str = ""
    per: str = ""
    scale: str = "linear"


def candidates(description: ModelDescription) -> list[ParameterCandidate]:
    """Return each real parameter with a start value, in the FMU's order; likely ones active."""
    found: list[ParameterCandidate] = []
    active = 0
    for variable in description.variables.values():
        if not _can_be_estimated(variable) or variable.start is None:
            continue
        bounds, origin = _bounds(variable, variable.start)
        same = next((c.variable.name for c in found if c.variable.name in variable.aliases), "")
        why_not = f"another name of {same}" if same else _why_not(variable, variable.start)
        if not why_not and active == MOST_ACTIVE:
            why_not = (
                f"{MOST_ACTIVE} parameters are enough to begin with; check says which parameters "
                "matter"
            )
        active += not why_not
        per = "experiment" if _INITIAL.search(variable.name) else ""
        found.append(ParameterCandidate(variable, variable.start, bounds, origin, why_not, per))
    return found


def initial_states(description: ModelDescription) -> list[ModelVariable]:
    """Return the states whose start value can be set."""
    states = (description.variables[name] for name in description.states)
    return [v for v in states if v.settable and v.kind == "real"]


def _can_be_estimated(variable: ModelVariable) -> bool:
    own = variable.alias_of is None and variable.kind == "real" and not variable.is_tool_setting
    return own and variable.causality == "parameter" and variable.settable


def _why_not(variable: ModelVariable, start: float) -> str:
    """Return why a parameter is not a likely candidate; "" if it is."""
    if variable.size > 1:
        return "one element of an array"
    unit = _CONSTANTS.get(variable.name)
    if unit is not None and (not variable.unit or conversion(variable.unit, unit) is not None):
        return "named like a constant of nature"
    if _INITIAL.search(variable.name):
        return "named like an initial value; estimate it if the experiments start differently"
    if _SPECIFIC_HEAT.fullmatch(variable.unit):
        return "a specific heat, which is known for most substances"
    if _SETTINGS.search(variable.name):
        return "named like a setting, not like a property"
    if start == 0.0:
        return "its start is 0, which does not show its order of magnitude; give a start and bounds"
    return ""


def _bounds(variable: ModelVariable, start: float) -> tuple[tuple[float, float] | None, str]:
    low, high = variable.low, variable.high
    inside = (low is None or low <= start) and (high is None or start <= high)
    if not inside:
        low = high = None
    guess, how = _guess(variable, start)
    if low is not None and high is not None and low < high:
        return (low, high), "bounds: the FMU's min and max"
    if start == 0.0:
        return None, "no bounds: its order of magnitude is unknown"
    if low == 0.0 < start:
        return guess, f"bounds: a guess, {how}; the FMU's min is 0"  # a model may divide by it
    if low is not None:
        return (low, max(guess[1], low + abs(start))), "bounds: the FMU's min, and a guess above"
    if high is not None:
        return (min(guess[0], high - abs(start)), high), "bounds: a guess below, and the FMU's max"
    said = "" if inside else "; the start value is outside the FMU's own min and max"
    return guess, f"bounds: a guess, {how}{said}"


def _guess(variable: ModelVariable, start: float) -> tuple[tuple[float, float], str]:
    if variable.unit in ("K", "degC"):
        ends, how = (start - _KELVINS, start + _KELVINS), f"{_KELVINS:g} K around the start value"
    else:
        ends, how = (
            (start / GUESSED_BOUND_FACTOR, start * GUESSED_BOUND_FACTOR),
            "from a tenth of the start value to ten times the start value",
        )
    low, high = sorted(float(f"{end:.12g}") for end in ends)
    return (low, high), how
