"""The columns of a measured table: signals, time, and the variables to which they belong."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.errors import DataError
from cluster_est.preflight.table_column import (
    TableColumn,
    fold,
    guessed_noise,
    split_suffix,
    with_suffix,
)
from cluster_est.preflight.table_times import (
    LOOKED_AT,
    FoundTime,
    clock_column,
    find_tests,
    find_time,
    may_hold_numbers,
    own_clocks,
    refusal,
)
from cluster_est.problem.tables.cells import is_switch, is_text, trimmed_cells
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.gaps import long_steps
from cluster_est.problem.tables.jumps import count_jumps, recorded_at_changes
from cluster_est.problem.tables.long_tables import long_columns, wide
from cluster_est.problem.tables.measured_table import (
    Column,
    MeasuredTable,
    Reading,
    UndecidedError,
)
from cluster_est.problem.tables.sparse_inputs import is_sparse
from cluster_est.problem.tables.stand_ins import is_missing, stand_ins
from cluster_est.problem.tables.units import conversion, is_known, split_unit
from workers.fmu.variable import ModelVariable
from workers.messages import FloatArray


@dataclass(frozen=True)
class TableColumns:
    """The columns of a table.

    Attributes
    ----------
    path
        Path of the table's file.
    signals
        Columns of numbers except the time, with all rows.
    time
        The column with the time; None if no column has such a name.
    increasing
        Names of columns that increase from row to row, if there is no time.
    unusable
        Reasons why columns contain no numbers, by name.
    reading, found
        The user's options for reading the file, and keys for what was detected.
    notes
        Sentences about how it was read.
    split_by, tests
        The column that distinguishes tests in it, and their names; empty for a single test.
    refused
        Reasons for columns of numbers with a value that is not a number, by name.
    missing
        Numbers of which the user says that they mark missing measurements.
    refusal
        Why check and fit refuse its times; "" if they do not.
    """

    path: Path
    signals: tuple[TableColumn, ...]
    time: TableColumn | None
    increasing: tuple[str, ...]
    unusable: Mapping[str, str]
    reading: Reading = field(default_factory=Reading)
    found: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    split_by: str = ""
    tests: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    missing: tuple[float, ...] = ()
    refusal: str = ""

    @property
    def named(self) -> dict[str, TableColumn]:
        """All columns of numbers by name, including the time."""
        every = self.signals if self.time is None else (self.time, *self.signals)
        return {column.name: column for column in every}


def read_columns(
    path: Path,
    time_column: str = "",
    reading: Reading | None = None,
    missing: tuple[float, ...] = (),
) -> TableColumns:
    """Read a table and classify its columns.

    Parameters
    ----------
    path
        Path of the table.
    time_column
        Name of the column with the time, if the table has it; otherwise it is found by name.
    reading
        The user's options for reading it.
    missing
        Numbers that mark missing measurements.

    Raises
    ------
    DataError
        If it cannot be read, or has no column of numbers.
    """
    table = read_table(path, "init", reading=reading)
    long = long_columns([*table.columns]) if table.reading.long is None else None
    if long is not None:
        table = replace(wide(table, *long), reading=replace(table.reading, long=long))
        table = replace(table, found={**table.found, "long": long})
    found = find_time(table, time_column)
    own = own_clocks(table)
    table = replace(table, clocks={**table.clocks, **own})
    if own and found is None:
        found = find_time(table)
    split_by = find_tests(table, found)
    tests = tuple(table.tests(split_by, "init")) if split_by else ()
    whole = table
    if tests:
        table = table.part(split_by, tests[0], "init")
        found = found if found is None else found.of(table)
    columns, others, refused = _columns(table, found, split_by, missing)
    clocks = {name: clock_column(table, name) for name in own}
    columns = [
        each
        if found is None or clocks.get(each.name, found.column).name == found.column.name
        else replace(each, clock=clocks[each.name])
        for each in columns
    ]
    if not columns and refused:
        raise DataError(next(iter(refused.values())))
    if not columns:
        raise DataError(
            f"init: {path} must have columns of numbers, but has none{_why_none(others)}; check "
            "the separator between columns, and that the first row has the names of the columns"
        )
    rising = [] if found is not None else [c.name for c in columns if c.increases]
    wrong = "" if found is None else refusal(found, table, [c.name for c in columns])
    return TableColumns(
        path,
        tuple(columns),
        None if found is None else found.column,
        tuple(rising),
        others,
        reading=whole.reading,
        found=whole.found,
        notes=(
            *whole.notes,
            *_note_on_clocks(own),
            *(_notes_on_times(found) if found is not None else ()),
            *(f"{why}; check and fit refuse the table until then" for why in (wrong,) if why),
        ),
        split_by=split_by,
        tests=tests,
        refused=refused,
        missing=missing,
        refusal=wrong,
    )


def _note_on_clocks(own: Mapping[str, str]) -> Iterator[str]:
    """Yield a note on signals with their own times."""
    if own:
        pairs = ", ".join(f"{clock!r} for {name!r}" for name, clock in own.items())
        yield f"its signals have their own times: {pairs}"


def _notes_on_times(found: FoundTime) -> Iterator[str]:
    """Yield notes on how times were read, and on missing rows."""
    if found.said:
        yield found.said
    gaps = long_steps(np.unique(found.seconds[np.isfinite(found.seconds)])).tolist()
    if gaps:
        first, last = gaps[0]
        more = f" (and {len(gaps) - 1} more gaps)" if len(gaps) > 1 else ""
        yield (
            f"no rows between {first:.10g} and {last:.10g} of {found.column.name!r}{more}; set "
            'gaps = "split" or "bridge" in the experiment to choose how the part after the gap is '
            "treated"
        )


def _columns(
    table: MeasuredTable, time: FoundTime | None, split_by: str, missing: Sequence[float]
) -> tuple[list[TableColumn], dict[str, str], dict[str, str]]:
    """Return the columns of numbers that can be signals, the others, and reasons for errors.

    Columns are read one at a time, so that a large file is not in memory twice.
    """
    refused: dict[str, str] = {}
    clocks = {*table.clocks.values(), *(() if time is None else time.names)}
    found: list[tuple[int, TableColumn]] = []
    counts: list[int] = []
    others = dict(table.unusable)
    for name in table.columns:
        if name in clocks or name == split_by:
            continue
        values = np.zeros(0)
        try:
            if name and may_hold_numbers(table.columns[name]):
                values = table.numbers(name, "init")
        except UndecidedError:
            raise
        except DataError as error:
            refused[name] = str(error)
        if not np.isfinite(values).any():
            others |= {name: _not_numbers(table.columns[name])} if name else {}
            continue
        times = None if time is None else time.times_of(table, name)
        rows = len(values) if times is None or len(times) != len(values) else -1
        plain, unit = split_unit(name)
        values = np.where(is_missing(values, missing), np.nan, values)
        codes = tuple(each.value for each in stand_ins(values))
        values = np.where(is_missing(values, codes), np.nan, values)
        clock = np.arange(float(len(values))) if times is None or rows >= 0 else times
        there = np.isfinite(values) & np.isfinite(clock)
        known = clock[there], values[there]
        column = TableColumn(
            name,
            plain,
            unit or table.units.get(name, ""),
            guessed_noise(values),
            count_jumps(*known) if time is None or rows < 0 else 0,
            increases=_increases(values),
            at_changes=time is not None and rows < 0 and recorded_at_changes(*known),
            stand_ins=codes,
            is_switch=is_switch(table.columns[name]),
        )
        found.append((rows, column))
        counts.append(int(there.sum()))
    found = _with_few(found, counts)
    if time is not None:
        return [column for rows, column in found if rows < 0], others, refused
    usual = Counter(rows for rows, _ in found).most_common(1)
    return [column for rows, column in found if usual and rows == usual[0][0]], others, refused


def _with_few(
    columns: Sequence[tuple[int, TableColumn]], counts: Sequence[int]
) -> list[tuple[int, TableColumn]]:
    """Mark columns with much fewer values than another; only these may be records of changes."""
    most = max(counts, default=0)
    return [
        (rows, replace(column, few=True))
        if is_sparse(count, most)
        else (rows, replace(column, at_changes=False))
        for (rows, column), count in zip(columns, counts, strict=True)
    ]


def _not_numbers(column: Column) -> str:
    """Return what a column contains instead of numbers."""
    if isinstance(column, np.ndarray) or not is_text(column):
        return "holds no numbers"
    there = trimmed_cells(column.slice(0, LOOKED_AT)).drop_null()
    return f"holds {there[0].as_py()!r}" if len(there) else "is empty"


def _why_none(others: Mapping[str, str]) -> str:
    """Return what is wrong with the first column that cannot be used."""
    return next((f" ({name!r} {why})" for name, why in others.items()), "")


def _increases(values: FloatArray) -> bool:
    return len(values) > 1 and bool(np.all(np.diff(values) > 0.0))


SIMILAR = 0.6
"""Ratio of `difflib` above which two names are similar."""

WITHOUT_UNIT = ("", "1", "%", "-")
"""Units that do not indicate a quantity."""
QUANTITIES = {"temperature": "K", "temp": "K", "pressure": "Pa", "voltage": "V", "current": "A"}
"""Words in the name of a column without a unit that indicate its quantity."""

_PARTS = re.compile(r"[A-Z]?[a-z0-9]+|[A-Z0-9]+")
"""Parts of a column's name: "u" and "Est" of "uEst"."""


@dataclass(frozen=True)
class ColumnMatch:
    """A variable and its column.

    Attributes
    ----------
    column
        The column with its name; None without such a column.
    similar
        A suggestion; None if no column is similar, or if `column` is certain.
    by_unit
        Whether the column is identified only by its unit, and no other name is similar.
    """

    variable: ModelVariable
    column: TableColumn | None = None
    similar: TableColumn | None = None
    by_unit: bool = False


def match(
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    given: Mapping[str, TableColumn] | None = None,
    named: Collection[str] = (),
) -> list[ColumnMatch]:
    """Match each variable to a column, and no column twice.

    A column matches if it has the same name, apart from case, blanks, underscores, brackets and a
    unit at its end. It matches if the last part of its name, after its group or structure, is such
    a name. It also matches if it is the only column whose unit is convertible to the variable's,
    and if the variable is the only one for this column. Otherwise a similar column is a suggestion,
    or the only remaining column, unless its unit contradicts.

    Parameters
    ----------
    given
        Known columns of variables.
    named
        Names of columns that have the names of model variables not matched here.
    """
    sure = same(variables, columns, given)
    left = _others(columns, sure)
    found = []
    for variable in variables:
        column = sure.get(variable.name)
        similar = None if column is not None else _most_similar(variable, left)
        if similar is not None:
            left.remove(similar)
            similar = with_suffix(similar, variable.unit)
        found.append(ColumnMatch(variable, column, similar))
    suggested = _by_unit(_last_one(found, left), left)
    own = [column for column in columns if column.name not in named]
    return [_decided(each, variables, columns, own) for each in suggested]


def _decided(
    match: ColumnMatch,
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    own: Sequence[TableColumn],
) -> ColumnMatch:
    """Return a suggestion as certain if units leave no other column and no other variable."""
    variable, column = match.variable, match.similar
    if column is None or column not in own or variable.unit in WITHOUT_UNIT:
        return match
    rivals = [v for v in variables if _of_kind(column, v)]
    others = [c for c in columns if _of_kind(c, variable)]
    if len(rivals) == len(others) == 1 and rivals[0] is variable and others[0] is column:
        return ColumnMatch(variable, column, by_unit=True)
    return match


def has_unit(variable: ModelVariable) -> bool:
    """Return whether a variable has a unit that indicates a quantity."""
    return variable.unit not in WITHOUT_UNIT


def forbidden(column: TableColumn, variable: ModelVariable) -> bool:
    """Return whether a column's unit, or the quantity in its name, contradicts the variable's."""
    if not variable.unit or not is_known(variable.unit):
        return False
    words = {word.casefold() for word in _PARTS.findall(column.plain)}
    units = [column.unit] if is_known(column.unit) else []
    units += [unit for word, unit in QUANTITIES.items() if word in words and not column.unit]
    return any(conversion(unit, variable.unit) is None for unit in units)


def same(
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    given: Mapping[str, TableColumn] | None = None,
) -> dict[str, TableColumn]:
    """Return the columns that are certain, by the variable's name."""
    own = given or {}
    sure = {v.name: with_suffix(own[v.name], v.unit) for v in variables if v.name in own}
    sure |= _same([(v, v.name) for v in variables], [(c, c.name) for c in columns], sure)
    sure |= _same([(v, v.name) for v in variables], [(c, c.plain) for c in columns], sure)
    folded = [(v, fold(v.name)) for v in variables]
    sure |= _same(folded, [(c, c.folded) for c in columns], sure)
    sure |= _same(folded, [(c, fold(c.last_part)) for c in columns], sure)
    return sure | _suffixed(variables, columns, sure)


def _others(columns: Sequence[TableColumn], taken: Mapping[str, TableColumn]) -> list[TableColumn]:
    names = {column.name for column in taken.values()}
    return [column for column in columns if column.name not in names]


def _suffixed(
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    taken: Mapping[str, TableColumn],
) -> dict[str, TableColumn]:
    """Return columns by variable whose name is the same apart from a unit at its end."""
    free = [c for c in _others(columns, taken) if "_" in c.name and not c.unit]
    pairs = []
    for variable in variables:
        wanted = fold(variable.name)
        for column in free if variable.name not in taken and wanted else ():
            if column.folded.startswith(wanted):
                found = split_suffix(column.name, variable.unit)
                if found is not None and fold(found[0]) == wanted:
                    pairs.append((variable, with_suffix(column, variable.unit)))
    names = Counter(variable.name for variable, _ in pairs)
    used = Counter(column.name for _, column in pairs)
    return {v.name: c for v, c in pairs if names[v.name] == used[c.name] == 1}


def _last_one(found: list[ColumnMatch], left: list[TableColumn]) -> list[ColumnMatch]:
    """Suggest the column if only one variable and one column remain."""
    open_ = [i for i, m in enumerate(found) if m.column is None and m.similar is None]
    if len(open_) == len(left) == 1 and not forbidden(left[0], found[open_[0]].variable):
        similar = with_suffix(left.pop(), found[open_[0]].variable.unit)
        found[open_[0]] = replace(found[open_[0]], similar=similar)
    return found


def _by_unit(found: list[ColumnMatch], left: list[TableColumn]) -> list[ColumnMatch]:
    """Suggest a column if it is the only remaining one whose unit fits a variable."""
    open_ = [i for i, m in enumerate(found) if m.column is None and m.similar is None]
    fitting = {i: [c for c in left if _of_kind(c, found[i].variable)] for i in open_}
    wanted = Counter(c.name for columns in fitting.values() for c in columns)
    for i, columns in fitting.items():
        if len(columns) == 1 and wanted[columns[0].name] == 1:
            found[i] = replace(found[i], similar=columns[0])
    return found


def _of_kind(column: TableColumn, variable: ModelVariable) -> bool:
    return bool(column.unit and variable.unit) and (
        conversion(column.unit, variable.unit) is not None
    )


def _same(
    variables: list[tuple[ModelVariable, str]],
    columns: list[tuple[TableColumn, str]],
    taken: Mapping[str, TableColumn],
) -> dict[str, TableColumn]:
    """Return columns by variable if a key is the same and unique on both sides."""
    names = {column.name for column in taken.values()}
    free = [(c, key) for c, key in columns if c.name not in names]
    open_ = [(v, key) for v, key in variables if v.name not in taken]
    counts = Counter(key for _, key in free)
    wanted = Counter(key for _, key in open_)
    unique = {key: c for c, key in free if key and counts[key] == 1}
    return {v.name: unique[key] for v, key in open_ if key in unique and wanted[key] == 1}


def _most_similar(variable: ModelVariable, columns: list[TableColumn]) -> TableColumn | None:
    """Return the column most similar to the variable's name, its last part or description."""
    scores = [
        (_score(variable, column), -i)
        for i, column in enumerate(columns)
        if not forbidden(column, variable)
    ]
    score, place = max(scores, default=(0.0, 0))
    return columns[-place] if score >= SIMILAR else None


def _score(variable: ModelVariable, column: TableColumn) -> float:
    names = [fold(variable.name), fold(variable.name.split(".")[-1])]
    ratios = [difflib.SequenceMatcher(None, name, column.folded).ratio() for name in names]
    parts = {fold(part) for part in _PARTS.findall(column.plain)}
    described = {fold(word) for word in re.findall(r"\w+", variable.description)}
    if parts & set(names) or (len(column.folded) > 1 and column.folded in described):
        ratios.append(SIMILAR)
    return max(ratios)
