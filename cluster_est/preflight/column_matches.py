"""Matches of a table's columns to the variables of an FMU, by names and units."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from cluster_est.preflight.table_column import TableColumn, fold, split_suffix, with_suffix
from cluster_est.problem.tables.units import conversion, is_known
from workers.fmu.variable import ModelVariable

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
