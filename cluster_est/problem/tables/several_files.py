"""One test in several files, such as one for each logger: their channels become one table.

All times count from one origin, that of the file that begins first. No clock is corrected: what the
times of the files show about their clocks is only said.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np

from cluster_est.errors import DataError
from cluster_est.problem.tables.gaps import STEPS_OF_GAP
from cluster_est.problem.tables.measured_table import Column, MeasuredTable
from cluster_est.problem.tables.times import JOINT, TableTimes, read_times
from cluster_est.toml import dotted
from workers.messages import FloatArray

_WORDS = re.compile(r"[^_\-. ]+")


def own_names(stems: Sequence[str]) -> list[str]:
    """Return the part of each file name that differs: "speed" of "run1_speed" and "run1_torque"."""
    words = [_WORDS.findall(stem) for stem in stems]

    def shared(rows: Sequence[Sequence[str]]) -> int:
        return len([*takewhile(lambda same: len({*same}) == 1, zip(*rows, strict=False))])

    first = shared(words)
    last = shared([row[first:][::-1] for row in words])
    own = ["_".join(row[first : len(row) - last]) for row in words]
    return own if all(own) and len({*own}) == len(own) else list(stems)


@dataclass(frozen=True)
class TimedFile:
    """One of the files of a test.

    Attributes
    ----------
    table, label
        Its table, and the part of its name that differs from those of the other files.
    times, names
        The times of its rows, and the names of their columns.
    clocks
        Times of columns with another clock in the same file.
    """

    table: MeasuredTable
    label: str
    times: TableTimes
    names: tuple[str, ...]
    clocks: dict[str, FloatArray] = field(default_factory=dict)

    @property
    def known(self) -> FloatArray:
        """The times of its rows that have one."""
        return self.times.seconds[np.isfinite(self.times.seconds)]

    @property
    def signals(self) -> list[str]:
        """Its columns except the times."""
        gone = {*self.names, *self.table.clocks.values()}
        return [name for name in self.table.columns if name not in gone]

    @property
    def name(self) -> str:
        return Path(self.table.path).name


def timed_files(
    tables: Sequence[MeasuredTable],
    time: str,
    where: str,
    scale: tuple[float | None, float] = (None, 0.0),
) -> list[TimedFile]:
    """Read the times of the files of one test; dates count from the file that begins first.

    Parameters
    ----------
    tables
        One table for each file, without several tests in it.
    time
        The time column of all files; with a *, the name may differ.
    where
        Start of each message.
    scale
        The user's factor and offset of the time column.

    Raises
    ------
    DataError
        If a file has no such column, or counts from another time than the others.
    """
    labels = own_names([Path(table.path).stem for table in tables])

    def read(since: TableTimes | None) -> Iterator[TimedFile]:
        for table, label in zip(tables, labels, strict=True):
            yield (found := _timed(table, label, time, where, scale, since))
            since = found.times if since is None else since

    files = [*read(None)]
    first = int(np.argmin([each.known[0] for each in files]))
    if first and files[0].times.origin is not None:
        files = [*read(_timed(tables[first], labels[first], time, where, scale, None).times)]
    return files


def join_files(files: Sequence[TimedFile], time: str) -> MeasuredTable:
    """Return the channels of several files as one table, each with the times of its file.

    The column `time` gets the times of all rows. A column whose name occurs in several files gets
    the file's part of the name: "speed.value".

    Raises
    ------
    DataError
        If the files have no time in common.
    """
    repeated = Counter(name for each in files for name in each.signals)
    columns: dict[str, Column] = {time: np.unique(np.concatenate([each.known for each in files]))}
    units: dict[str, str] = {}
    clocks: dict[str, str] = {}
    places: dict[str, tuple[MeasuredTable, str]] = {}
    for each in files:
        for name in each.signals:
            own = f"{each.label}.{name}" if repeated[name] > 1 else name
            clock = each.table.clocks.get(name, time)
            clocks[own] = f"{clock if clock in each.clocks else time} of {each.label}"
            columns[clocks[own]] = each.clocks.get(clock, each.times.seconds)
            columns[own], places[own] = each.table.columns[name], (each.table, name)
            units |= {own: unit} if (unit := each.table.units.get(name)) else {}
    return MeasuredTable(
        " + ".join([str(files[0].table.path), *(each.name for each in files[1:])]),
        columns,
        {name: why for each in files for name, why in each.table.unusable.items()},
        units=units,
        clocks=clocks,
        notes=tuple(_notes(files)),
        reading=files[0].table.reading,
        files=places,
        dated=files[0].times.origin is not None,
    )


def _notes(files: Sequence[TimedFile]) -> Iterator[str]:
    """Yield how the files were read, and what their times show about their clocks."""
    yield from (f"{each.name}: {said}" for each in files for said in each.table.notes)
    if files[0].times.said:
        yield files[0].times.said
    yield from clock_notes(files)


def clock_notes(files: Sequence[TimedFile]) -> Iterator[str]:
    """Yield what the times of the files show, or do not show, about their clocks.

    Raises
    ------
    DataError
        If files have no time in common.
    """
    yield from clock_differences(files)
    if files[0].times.origin is None and all(each.known[0] == 0.0 for each in files):
        yield (
            "the times of every file begin at 0, so they do not show whether the files began at "
            "the same time; if one began later, give its columns the negative delay as late"
        )


def _timed(
    table: MeasuredTable,
    label: str,
    time: str,
    where: str,
    scale: tuple[float | None, float],
    since: TableTimes | None,
) -> TimedFile:
    """Return a file with its times, which count like those of the first file."""
    if table.signals:
        raise DataError(
            f"{where}: {table.path} has a row for each value (long), so it cannot be one of "
            "several files of a test; make one table of them"
        )
    names = [table.resolved(part, where) for part in time.split(JOINT)]
    for name in names:
        if name not in table.columns:
            raise DataError(
                f"{where}.time: every file of a test needs this column (with a * its name may "
                f"differ), but {table.without(name)}"
            )
    factor, offset = scale

    def read(column: str) -> TableTimes:
        return read_times(table, column, None, where, factor=factor, offset=offset, since=since)

    times = read(JOINT.join(names))
    if since is not None and times.origin != since.origin:
        raise DataError(
            f"{where}: {table.path}, column {time!r}: the times of all files of a test must count "
            "from the same time, but some of them are dates or times since 1970, and others are "
            "not; convert them"
        )
    if not np.isfinite(times.seconds).any():
        raise DataError(f"{where}: {table.path} must have times in {time!r}, but has none")
    others = {clock for clock in table.clocks.values() if clock not in names}
    clocks = {clock: read(clock).seconds for clock in others}
    return TimedFile(table, label, times, tuple(names), clocks)


def clock_differences(files: Sequence[TimedFile]) -> Iterator[str]:
    """Yield a sentence for each file that begins or ends at other times than the longest file.

    They differ if they do so by more than a gap would last in the slower of two files.

    Raises
    ------
    DataError
        If files have no time in common.
    """
    longest = max(files, key=lambda each: float(np.ptp(each.known)))
    low, high = (float(each) for each in longest.known[[0, -1]])
    for each in files:
        first, last = (float(value) for value in each.known[[0, -1]])
        spans = (
            f"the times of {each.name} go from {first:.10g} to {last:.10g} s, those of "
            f"{longest.name} from {low:.10g} to {high:.10g} s"
        )
        if not (first <= high and low <= last):
            raise DataError(
                f"{spans}, so they have no time in common; check that they are files of one test, "
                "and that their clocks count from the same time and in the same unit"
            )
        slow = STEPS_OF_GAP * max(_step(each), _step(longest))
        begins, ends = first - low, last - high
        if max(abs(begins), abs(ends)) <= slow:
            continue
        key = f"{dotted('columns', next(iter(each.signals), 'COLUMN'))} = {{ late = {begins:.6g} }}"
        if abs(begins - ends) <= slow < min(abs(begins), abs(ends)):
            spans += (
                f", as if the clock of {each.name} were {abs(begins):.6g} s "
                f"{'ahead' if begins > 0 else 'behind'}; nothing was corrected; if it is so, write "
                f"{key}"
            )
        yield spans


def _step(file: TimedFile) -> float:
    return float(np.median(np.diff(file.known))) if len(file.known) > 1 else 0.0
