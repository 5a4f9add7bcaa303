"""Reads dates and times of day, as text or in Arrow's types for times.

A format is a pattern with named parts. All rows must fit one format, with valid days and months. If
two formats fit (01/02/2024) and give different seconds between rows, the user must choose one.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any, Final, Literal
from zoneinfo import ZoneInfo

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.problem.tables.cells import is_text, trimmed_cells
from cluster_est.problem.tables.measured_table import Column, Reading
from cluster_est.toml import inline

Nanoseconds = npt.NDArray[np.int64]
Kind = Literal["date", "clock", "instant", "elapsed"]
ROWS_AT_ONCE: Final = 500_000
SECOND: Final = 1_000_000_000
HOUR, DAY = 3600 * SECOND, 86400 * SECOND
_SECONDS: Final = r":(?P<S>\d{2})(?:[.,](?P<f>\d{1,12})|:(?P<k>\d{3}))?"
_HALF: Final = r"(?: ?(?P<p>[AaPp]\.?[Mm]\.?))?"
_DAY: Final = r"(?:[A-Za-z]{2,9}[.,]* )?"
"""The name of a day of the week, which is ignored."""
_CLOCK: Final = rf"(?P<H>\d{{1,3}}):(?P<M>\d{{2}})(?:{_SECONDS})?{_HALF}"
_ZONE: Final = r"(?: ?(?P<z>Z|UTC|GMT|CES?T|MES?Z|[+-]\d{2}(?::?\d{2})?))?"
_DATES: Final = {
    "%Y-%m-%d": r"(?P<Y>\d{4})-(?P<m>\d{1,2})-(?P<d>\d{1,2})",
    "%Y/%m/%d": r"(?P<Y>\d{4})/(?P<m>\d{1,2})/(?P<d>\d{1,2})",
    "%Y.%m.%d": r"(?P<Y>\d{4})\.(?P<m>\d{1,2})\.(?P<d>\d{1,2})",
    "%d.%m.%Y": r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<Y>\d{4})",
    "%d.%m.%y": r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<y>\d{2})",
    "%d/%m/%Y": r"(?P<d>\d{1,2})/(?P<m>\d{1,2})/(?P<Y>\d{4})",
    "%m/%d/%Y": r"(?P<m>\d{1,2})/(?P<d>\d{1,2})/(?P<Y>\d{4})",
    "%d/%m/%y": r"(?P<d>\d{1,2})/(?P<m>\d{1,2})/(?P<y>\d{2})",
    "%m/%d/%y": r"(?P<m>\d{1,2})/(?P<d>\d{1,2})/(?P<y>\d{2})",
    "%y/%m/%d": r"(?P<y>\d{2})/(?P<m>\d{1,2})/(?P<d>\d{1,2})",
    "%d-%m-%Y": r"(?P<d>\d{1,2})-(?P<m>\d{1,2})-(?P<Y>\d{4})",
    "%m-%d-%Y": r"(?P<m>\d{1,2})-(?P<d>\d{1,2})-(?P<Y>\d{4})",
    "%d-%m-%y": r"(?P<d>\d{1,2})-(?P<m>\d{1,2})-(?P<y>\d{2})",
    "%m-%d-%y": r"(?P<m>\d{1,2})-(?P<d>\d{1,2})-(?P<y>\d{2})",
    "%y-%m-%d": r"(?P<y>\d{2})-(?P<m>\d{1,2})-(?P<d>\d{1,2})",
    "%d-%b-%Y": r"(?P<d>\d{1,2})[- ](?P<b>[A-Za-zä]{3,9})\.?[- ](?P<Y>\d{4})",
    "%b %d, %Y": r"(?P<b>[A-Za-zä]{3,9})\.? (?P<d>\d{1,2}),? (?P<Y>\d{4})",
    "%Y-%j": r"(?P<Y>\d{4})-(?P<j>\d{3})",
    "%Y%m%d": r"(?P<Y>\d{4})(?P<m>\d{2})(?P<d>\d{2})",
}
_COMPACT: Final = r"(?P<H>\d{2})(?P<M>\d{2})(?P<S>\d{2})(?:[.,](?P<f>\d{1,12}))?"
_MONTH_AND_DAY: Final = r"(?P<b>[A-Za-z]{3}) +(?P<d>\d{1,2})"
_MINUTES: Final = r"(?P<M>\d{1,4}):(?P<S>\d{2})(?:[.,](?P<f>\d{1,12}))?"
_OF_DATES: Final = {"d", "m", "b", "Y", "y"}
_MONTHS: Final = {
    name: number
    for number, names in enumerate(
        ("jan", "feb", "mar mär mrz", "apr", "may mai", "jun", "jul", "aug", "sep", "oct okt",
         "nov", "dec dez"), 1
    )
    for name in names.split()
}  # fmt: skip
_ZONES: Final = {"Z": 0, "UTC": 0, "GMT": 0, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "": 0}
_PARTS: Final = {
    "%Y": r"(?P<Y>\d{4})", "%y": r"(?P<y>\d{2})", "%m": r"(?P<m>\d{1,2})",
    "%d": r"(?P<d>\d{1,2})", "%b": r"(?P<b>[A-Za-zä]{3,9})", "%H": r"(?P<H>\d{1,2})",
    "%I": r"(?P<H>\d{1,2})", "%M": r"(?P<M>\d{1,2})", "%f": r"(?P<f>\d{1,12})",
    "%p": r"(?P<p>[AaPp][Mm])", "%z": r"(?P<z>Z|[+-]\d{2}(?::?\d{2})?)",
    "%S": r"(?P<S>\d{1,2})(?:[.,](?P<f>\d{1,12}))?", "%%": "%",
}  # fmt: skip
"""Patterns for the parts of a user's format; "%S" may have decimals."""


@dataclass(frozen=True)
class Stamps:
    """Times of rows.

    Attributes
    ----------
    ns : (n,)
        Nanoseconds: since 1970 for instants and dates, since midnight for clocks, or elapsed.
    kind
        The kind of these times.
    known : (n,)
        Whether a row has a time.
    aware
        Whether the times are universal times, because the zone is known.
    said
        How the times were read, as part of a sentence.
    """

    ns: Nanoseconds
    kind: Kind
    known: npt.NDArray[np.bool_]
    aware: bool
    said: str = ""


class StampError(ValueError):
    """Raised for times that cannot be read.

    Attributes
    ----------
    index
        The first row that cannot be read; None if the error does not concern a single row.
    """

    def __init__(self, said: str, index: int | None = None) -> None:
        super().__init__(said)
        self.index = index


def read_stamps(column: Column, reading: Reading) -> Stamps | None:
    """Read a column as times; None if it contains no dates, times of day or durations.

    Raises
    ------
    StampError
        If the times are ambiguous, or no format fits all of them.
    """
    if isinstance(column, np.ndarray):
        return None
    kind = column.type
    if is_text(column):
        return _from_text(column, reading)
    if pa.types.is_timestamp(kind):
        ns, known = _integers(column.cast(pa.timestamp("ns", kind.tz)))
        return Stamps(ns, "instant", known, kind.tz is not None)
    if pa.types.is_date(kind):
        return Stamps(*_with(_integers(column.cast(pa.timestamp("ns"))), "date"))
    if pa.types.is_time(kind):
        return Stamps(*_with(_integers(column.cast(pa.time64("ns"))), "clock"))
    if pa.types.is_duration(kind):
        return Stamps(*_with(_integers(column.cast(pa.duration("ns"))), "elapsed"))
    return None


def _integers(column: pa.ChunkedArray) -> tuple[Nanoseconds, npt.NDArray[np.bool_]]:
    numbers = column.cast(pa.int64())
    known = numbers.is_valid().to_numpy()
    return numbers.fill_null(0).to_numpy().astype(np.int64), np.asarray(known, bool)


def _with(
    found: tuple[Nanoseconds, npt.NDArray[np.bool_]], kind: Kind
) -> tuple[Nanoseconds, Kind, npt.NDArray[np.bool_], bool]:
    return found[0], kind, found[1], False


def added(date: Stamps, clock: Stamps) -> Stamps:
    """Return the instants given by a column of dates and a column of times of day."""
    if date.kind == "clock":
        date, clock = clock, date
    if (date.kind, clock.kind) not in (("date", "clock"), ("instant", "clock")):
        raise StampError("must be a column of dates and a column of times of day, but are not")
    known = date.known & clock.known
    return Stamps(date.ns + clock.ns, "instant", known, clock.aware, date.said)


def finished(stamps: Stamps, reading: Reading) -> Stamps:
    """Return times that increase past midnight, and universal times if the zone is known.

    Raises
    ------
    StampError
        If daylight saving time may have begun or ended, and the zone is not known.
    """
    if stamps.kind == "clock":
        return _over_midnight(stamps)
    if stamps.kind != "instant" or stamps.aware:
        return stamps
    if reading.time_zone:
        ns = _universal(stamps.ns, _zone(reading.time_zone))
        return replace(stamps, ns=ns, aware=True, said=f"{stamps.said} of {reading.time_zone}")
    _refuse_changed_clocks(stamps)
    return stamps


def _from_text(column: pa.ChunkedArray, reading: Reading) -> Stamps | None:
    """Read text in blocks of rows, because its parts need much more memory than the times."""
    parts = [column.slice(at, ROWS_AT_ONCE) for at in range(0, len(column), ROWS_AT_ONCE)]
    first = next((cell for part in parts if (cell := _first(part)) is not None), None)
    if first is None:
        return None
    patterns = [(reading.time_format, _pattern_of(reading.time_format))]
    if not reading.time_format:
        patterns = [(name, each) for name, each in _patterns() if re.fullmatch(each, first)]
    if not patterns:
        return None
    found = [(name, *_joined(parts, pattern)) for name, pattern in patterns]
    good = [(name, stamps) for name, stamps, bad in found if stamps is not None and bad is None]
    if not good:
        index = max(-1 if bad is None else bad for _, _, bad in found)
        if index < 0:
            return None
        raise StampError(
            f"must be a time like the others, {patterns[0][0]}, but is {column[index].as_py()!r}; "
            'correct it, or give the format of the times, as in time_format = "%d.%m.%Y %H:%M:%S"',
            index,
        )
    return _told(good)


def _first(column: pa.ChunkedArray) -> str | None:
    """Return the first cell of a column with a value."""
    cells = trimmed_cells(column).drop_null()
    return str(cells[0].as_py()) if len(cells) else None


def _joined(parts: Sequence[pa.ChunkedArray], pattern: str) -> tuple[Stamps | None, int | None]:
    """Return times by a pattern, and the first cell that does not fit."""
    found: list[Stamps] = []
    for i, part in enumerate(parts):
        stamps, bad = _parsed(trimmed_cells(part), pattern)
        if stamps is None or bad is not None:
            return None, i * ROWS_AT_ONCE + (bad or 0)
        found.append(stamps)
    aware = {each.aware for each in found if each.known.any()}
    if len(aware) > 1:
        return None, 0
    ns = np.concatenate([each.ns for each in found])
    known = np.concatenate([each.known for each in found])
    return Stamps(ns, found[0].kind, known, aware == {True}), None


def _told(good: Sequence[tuple[str, Stamps]]) -> Stamps:
    """Return the times if all fitting formats give the same seconds between rows."""
    name, first = good[0]
    others = [(n, s) for n, s in good[1:] if not _same_seconds(first, s)]
    if others:
        choices = " or ".join(inline(n) for n in (name, *(n for n, _ in others)))
        raise StampError(f"can be read in several ways; choose one with time_format = {choices}")
    said = f"times are read as {name}"
    if len(good) > 1:
        said += f" (reading them as {good[1][0]} gives the same seconds)"
    return replace(first, said=said)


def _same_seconds(one: Stamps, other: Stamps) -> bool:
    a, b = one.ns[one.known], other.ns[other.known]
    return one.kind == other.kind and np.array_equal(a - a[0], b - b[0])


def _patterns() -> Iterator[tuple[str, str]]:
    """Yield the names and patterns of the known formats."""
    for name, date in _DATES.items():
        if name != "%Y%m%d":  # such a date may be a number
            yield name, date
        yield f"{name} %H:%M:%S", rf"\[?{_DAY}{date}(?:T|,? +|_){_CLOCK}{_ZONE}\]?"
    yield "%b %d %H:%M:%S %Y", rf"{_DAY}{_MONTH_AND_DAY} +{_CLOCK} (?P<Y>\d{{4}})"
    yield "days %H:%M:%S", rf"(?P<D>\d{{1,5}}) days? +(?P<H>\d{{1,2}}):(?P<M>\d{{2}}){_SECONDS}"
    yield "%Y%m%d %H%M%S", rf"{_DATES['%Y%m%d']}[T _-]{_COMPACT}{_ZONE}"
    yield "%H:%M:%S", rf"(?P<H>\d{{1,3}}):(?P<M>\d{{2}}){_SECONDS}{_HALF}"
    yield "%H:%M", rf"(?P<H>\d{{1,3}}):(?P<M>\d{{2}}){_HALF}"
    yield "%M:%S", _MINUTES


def _pattern_of(given: str) -> str:
    """Return the pattern of a user's format."""
    parts = re.split(r"(%.)", given)
    seen: set[str] = set()
    found = []
    for part in parts:
        pattern = _PARTS.get(part)
        if part.startswith("%") and pattern is None and len(part) == 2:
            raise StampError(
                f"time_format: must have only the parts {', '.join(_PARTS)}, but has {part!r}"
            )
        if part == "%S" and "%f" in parts:
            pattern = r"(?P<S>\d{1,2})"
        if pattern is not None and part in seen:
            raise StampError(f"time_format: must have {part!r} once, but has it twice; remove one")
        seen.add(part)
        found.append(re.escape(part).replace("\\ ", " +") if pattern is None else pattern)
    return "".join(found)


def _parsed(cells: pa.ChunkedArray, pattern: str) -> tuple[Stamps | None, int | None]:
    """Return times by a pattern, and the first cell that does not fit."""
    known = cells.is_valid().to_numpy()
    parts = pc.extract_regex(cells, rf"^(?:{pattern})$")
    fits = parts.is_valid().to_numpy()
    bad = known & ~fits
    if bad.any():
        return None, int(np.argmax(bad))
    there = set(re.findall(r"\?P<(\w)>", pattern))

    def text(name: str) -> pa.ChunkedArray:
        return pc.fill_null(pc.struct_field(parts, name), "")

    def number(name: str, default: int = 0) -> Nanoseconds:
        if name not in there:
            return np.full(len(cells), default, np.int64)
        cell = text(name)
        whole = pc.if_else(pc.equal(cell, ""), str(default), cell)
        return np.asarray(whole.cast(pa.int64()).to_numpy(), np.int64)

    month = _months(text("b")) if "b" in there else number("m", 1)
    year = 2000 + number("y") if "y" in there else number("Y", 1970)
    days, valid = _days(year, month, number("d", 1))
    days, valid = days + number("j", 1) - 1, valid & (number("j", 1) <= 366)
    hour, half = number("H"), text("p") if "p" in there else None
    if half is not None:
        hour, fine = _of_halves(hour, half)
        valid &= fine
    ns = number("S") * SECOND + number("M") * 60 * SECOND + hour * HOUR + number("k") * 1_000_000
    ns += number("D") * DAY
    if "f" in there:
        digits = pc.utf8_slice_codeunits(pc.utf8_rpad(text("f"), 9, padding="0"), 0, 9)
        ns += np.asarray(digits.cast(pa.int64()).to_numpy(), np.int64)
    dated = bool(there & _OF_DATES)
    valid &= (number("S") <= 60) & ((number("M") < 60) | ("H" not in there))
    valid &= (hour < 24) if dated else True
    zone, aware = _offsets(text("z")) if "z" in there else (0, False)
    bad = known & ~valid
    if aware is None:
        return None, 0
    if bad.any():
        return None, int(np.argmax(bad))
    return Stamps(days * DAY + ns - zone, _kind(there), known, bool(aware)), None


def _kind(there: Set[str]) -> Kind:
    """Return the kind of times that a format with these parts describes."""
    if "D" in there:
        return "elapsed"
    if not there & _OF_DATES:
        return "clock"
    return "instant" if there & {"H", "M", "S"} else "date"


def _days(
    year: Nanoseconds, month: Nanoseconds, day: Nanoseconds
) -> tuple[Nanoseconds, npt.NDArray[np.bool_]]:
    """Return days since 1970, and a mask of valid dates."""
    valid = (month >= 1) & (month <= 12) & (day >= 1) & (year >= 1678) & (year <= 2261)
    months = np.where(valid, (year - 1970) * 12 + month - 1, 0)
    first = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    after = (months + 1).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return first + day - 1, valid & (day <= after - first)


def _months(names: pa.ChunkedArray) -> Nanoseconds:
    short = pc.utf8_slice_codeunits(pc.utf8_lower(names), 0, 3).combine_chunks().dictionary_encode()
    numbers = np.array([_MONTHS.get(n, 0) for n in short.dictionary.to_pylist()], np.int64)
    return np.asarray(numbers[short.indices.to_numpy(zero_copy_only=False)], np.int64)


def _of_halves(
    hour: Nanoseconds, half: pa.ChunkedArray
) -> tuple[Nanoseconds, npt.NDArray[np.bool_]]:
    """Return 24-hour values from 12-hour values with AM or PM, and a mask of valid hours."""
    letter = np.asarray(pc.utf8_slice_codeunits(pc.utf8_lower(half), 0, 1).to_numpy(), str)
    given = letter != ""
    whole = hour % 12 + np.where(letter == "p", 12, 0)
    return np.where(given, whole, hour), ~given | ((hour >= 1) & (hour <= 12))


def _offsets(zones: pa.ChunkedArray) -> tuple[Any, bool | None]:
    """Return nanoseconds ahead of universal time, and `aware`; None if some rows lack a zone."""
    codes = zones.combine_chunks().dictionary_encode()
    names = codes.dictionary.to_pylist()
    if "" in names and len(names) > 1:
        return 0, None
    ahead = np.array([_ahead(name) for name in names], np.int64)
    return ahead[codes.indices.to_numpy(zero_copy_only=False)], names != [""]


def _ahead(zone: str) -> int:
    if zone in _ZONES:
        return _ZONES[zone] * HOUR
    digits = zone[1:].replace(":", "").ljust(4, "0")
    size = int(digits[:2]) * HOUR + int(digits[2:]) * 60 * SECOND
    return -size if zone[0] == "-" else size


def _over_midnight(stamps: Stamps) -> Stamps:
    """Return times of day that continue to increase after midnight."""
    known = stamps.ns[stamps.known]
    nights = np.concatenate([[0], np.cumsum(np.diff(known) < -DAY // 2)])
    if not len(known) or not nights[-1]:
        return stamps
    ns = stamps.ns.copy()
    ns[stamps.known] = known + nights * DAY
    return replace(
        stamps, ns=ns, said=f"{stamps.said or 'times of day'}; the record runs past midnight"
    )


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError):
        raise StampError(
            f"time_zone: must be a time zone such as Europe/Berlin, but is {name!r}; correct it, "
            "or install the time zones with: pip install tzdata"
        ) from None


def _universal(ns: Nanoseconds, zone: ZoneInfo) -> Nanoseconds:
    """Return universal times from local times; a repeated hour is resolved by the order of rows."""
    hours, place = np.unique(ns // (HOUR // 4), return_inverse=True)
    quarter = HOUR // 4
    early, late = (_ahead_of(hours * quarter, zone, fold) for fold in (0, 1))
    first = early[place]
    twice = first != late[place]
    if not twice.any():
        return ns - first
    ahead = first.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], twice, [False]])))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        turns = np.flatnonzero(np.diff(ns[begin:end]) < 0)
        joined = end < len(ns) and ns[end] - ns[end - 1] < HOUR // 2
        apart = begin == 0 or ns[begin] - ns[begin - 1] >= HOUR // 2
        if len(turns):
            begin += int(turns[0]) + 1
        elif not (joined and apart):
            continue
        ahead[begin:end] = late[place[begin:end]]
    return ns - ahead


def _ahead_of(local: Nanoseconds, zone: ZoneInfo, fold: int) -> Nanoseconds:
    start = datetime.datetime(1970, 1, 1)
    found = []
    for each in (local // SECOND).tolist():
        when = (start + datetime.timedelta(seconds=each)).replace(tzinfo=zone, fold=fold)
        offset = when.utcoffset()
        found.append(int(offset.total_seconds()) * SECOND if offset is not None else 0)
    return np.array(found, np.int64)


def _refuse_changed_clocks(stamps: Stamps) -> None:
    """Refuse local times with steps as at the begin or end of daylight saving time."""
    ns = stamps.ns[stamps.known]
    steps = np.diff(ns)
    if not len(steps):
        return
    usual = max(int(np.median(steps)), 1)
    hour = (ns[:-1] + usual) % DAY // HOUR
    odd = (steps <= -HOUR + 2 * usual) & (steps >= -HOUR - usual)
    sunday = ns[1:] // DAY % 7 == 3  # 1970 began on a Thursday
    odd |= sunday & (hour <= 3) & (steps >= HOUR) & (steps <= HOUR + 2 * usual)
    if usual < HOUR // 2 and odd.any():
        i = int(np.argmax(odd))
        row = int(np.flatnonzero(stamps.known)[i + 1])
        before, after = (
            np.datetime64(int(each), "ns").astype("datetime64[s]") for each in ns[i : i + 2]
        )
        raise StampError(
            f"goes from {before} to {after}, as if clocks were changed for summer time; give the "
            'place of the recording, as in time_zone = "Europe/Berlin", or write time_zone = "UTC" '
            "if the clocks were not changed",
            row,
        )
