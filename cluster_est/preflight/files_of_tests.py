"""Files of one test, such as one for each logger, found by their names, columns and times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from cluster_est.errors import DataError
from cluster_est.preflight.draft_sources import DraftSource
from cluster_est.preflight.table_columns import TableColumns, columns_of
from cluster_est.preflight.table_times import FoundTime
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.several_files import clock_differences, join_files, timed_files
from cluster_est.problem.tables.times import JOINT
from cluster_est.problem.tables.units import conversion
from cluster_est.toml import inline

Pair = tuple[DraftSource, TableColumns]
_SEPARATORS = re.compile(r"[_\-. ]+")


def with_joined_files(
    tables: Sequence[Pair], missing: tuple[float, ...]
) -> tuple[list[Pair], tuple[str, ...]]:
    """Return the tables with the files of each test as one table, and sentences about this.

    Nothing is joined if only the names say so: the files must have different columns, and the same
    times.
    """
    groups = _groups(tables)
    found: list[Pair] = []
    notes: list[str] = []
    for name, group in groups.items():
        called = ", ".join(source.path.name for source, _ in group)
        try:
            found.append(_joined(name, group, missing))
        except DataError as error:
            data = inline([source.path.name for source, _ in group])
            reason = str(error).removeprefix("init: ")
            return list(tables), (
                f"{called}: by their names and columns, these are files of one test, but {reason}; "
                f"so each file became an experiment; if this is one test, write data = {data}",
            )
        notes.append(f"{called}: joined as the files of one test, {name!r}")
    return (found, tuple(notes)) if groups else (list(tables), ())


def _groups(tables: Sequence[Pair]) -> dict[str, list[Pair]]:
    """Return the files of each test by the test's name; empty if the names do not show any.

    One word of the names must tell the files of a test apart. These have different columns, and the
    same columns in each test.
    """
    if not all(_may_be_joined(*each) for each in tables):
        return {}
    words = [_SEPARATORS.split(source.path.stem) for source, _ in tables]
    found = []
    for place in range(min(map(len, words), default=0)):
        groups: dict[str, dict[str, Pair]] = {}
        for row, pair in zip(words, tables, strict=True):
            test = "_".join(row[:place] + row[place + 1 :])
            groups.setdefault(test, {}).setdefault(row[place], pair)
        kinds = [{word: _names(own) for word, own in group.items()} for group in groups.values()]
        every = [name for names in kinds[0].values() for name in names]
        whole = sum(map(len, groups.values())) == len(tables) and "" not in groups
        several = len(kinds[0]) > 1 and all(kind == kinds[0] for kind in kinds)
        if whole and several and len({*every}) == len(every):
            found.append({test: [*group.values()] for test, group in groups.items()})
    return found[0] if len(found) == 1 else {}


def _may_be_joined(source: DraftSource, columns: TableColumns) -> bool:
    alone = source.test is None and not columns.tests and not source.lines and not source.id
    return alone and columns.time is not None and columns.reading.long is None


def _names(pair: Pair) -> frozenset[str]:
    return frozenset(column.name for column in pair[1].signals)


def _joined(name: str, group: Sequence[Pair], missing: tuple[float, ...]) -> Pair:
    """Return the table of a test in several files.

    Raises
    ------
    DataError
        If their times are not the same.
    """
    source, first = group[0]
    time = first.time
    names = {own.time.name for _, own in group if own.time is not None}
    if time is None or len(names) > 1:
        raise DataError(f"their time columns have different names, {' and '.join(sorted(names))}")
    tables = [read_table(each.path, "init", reading=own.reading) for each, own in group]
    found = conversion(time.unit, "s") if time.unit else None
    scale = None if found is None else found.factor
    files = timed_files(tables, time.name, "init", (scale, 0.0))
    for said in clock_differences(files):
        raise DataError(said)
    table = join_files(files, time.name)
    every = [own.found for _, own in group]
    common = {k: v for k, v in first.found.items() if all(each.get(k) == v for each in every)}
    table = replace(table, found=common)
    seconds = table.numbers(time.name, "init")
    times = FoundTime(time, tuple(time.name.split(JOINT)), seconds)
    columns = replace(columns_of(table, times, {}, missing), reading=first.reading)
    return replace(source, id=name), replace(columns, files=tuple(s.path for s, _ in group))
