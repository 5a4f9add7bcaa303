"""Matches between the columns of a table and the variables of an FMU."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cluster_est.drafting.columns import TableColumn, fold, split_suffix, with_suffix
from cluster_est.problem.tables.units import conversion
from workers.fmu.variable import ModelVariable

SIMILAR = 0.6
"""Ratio of `difflib` from which two names look alike."""

_PARTS = re.compile(r"[A-Z]?[a-z0-9]+|[A-Z0-9]+")
"""Of a column's name: "u" and "Est" of "uEst"."""


@dataclass(frozen=True)
class ColumnMatch:
    """A variable and its column.

    Attributes
    ----------
    column
        The column of its name; None if there is none.
    similar
        A suggestion; None if there is none, or `column` is certain.
    """

    variable: ModelVariable
    column: TableColumn | None = None
    similar: TableColumn | None = None


def match(
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    given: Mapping[str, TableColumn] | None = None,
) -> list[ColumnMatch]:
    """Match each variable to a column, and no column twice.

    A column has the same name, or the same but for case, blanks, underscores, brackets and a unit
    at its end. Where neither decides, a similar column is a suggestion, or the only one that is
    left, or the only one with a unit that can be converted to the variable's.

    Parameters
    ----------
    given
        Columns of variables that are known.
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
    return _by_unit(_last_one(found, left), left)


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
    return sure | _suffixed(variables, columns, sure)


def _others(columns: Sequence[TableColumn], taken: Mapping[str, TableColumn]) -> list[TableColumn]:
    names = {column.name for column in taken.values()}
    return [column for column in columns if column.name not in names]


def _suffixed(
    variables: Sequence[ModelVariable],
    columns: Sequence[TableColumn],
    taken: Mapping[str, TableColumn],
) -> dict[str, TableColumn]:
    """Return columns by variable where the name is the same but for a unit at its end."""
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
    """Suggest the column if one variable and one column are left over."""
    open_ = [i for i, m in enumerate(found) if m.column is None and m.similar is None]
    if len(open_) == len(left) == 1:
        similar = with_suffix(left.pop(), found[open_[0]].variable.unit)
        found[open_[0]] = replace(found[open_[0]], similar=similar)
    return found


def _by_unit(found: list[ColumnMatch], left: list[TableColumn]) -> list[ColumnMatch]:
    """Suggest a column where it alone, of those left over, has a unit of a variable's kind."""
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
    """Return columns by variable where a key is the same and unique on both sides."""
    names = {column.name for column in taken.values()}
    free = [(c, key) for c, key in columns if c.name not in names]
    open_ = [(v, key) for v, key in variables if v.name not in taken]
    counts = Counter(key for _, key in free)
    wanted = Counter(key for _, key in open_)
    unique = {key: c for c, key in free if key and counts[key] == 1}
    return {v.name: unique[key] for v, key in open_ if key in unique and wanted[key] == 1}


def _most_similar(variable: ModelVariable, columns: list[TableColumn]) -> TableColumn | None:
    """Return the column most similar to the variable's name, its last part or description."""
    scores = [(_score(variable, column), -i) for i, column in enumerate(columns)]
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
