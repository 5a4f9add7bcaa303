"""Numbers that mark missing measurements, such as -9999, 65535 or 9.9e37 among smaller values.

Loggers write them if a sensor gives no value. A fit that uses them as measurements follows mainly
these numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from workers.messages import Experiment, FloatArray

NINES = (
    *(sign * (10.0**digits - 1.0) for digits in range(2, 8) for sign in (-1.0, 1.0)),
    *(sign * 999.9 for sign in (-1.0, 1.0)),
    -999.25,
    -9999.25,
)
"""Numbers that loggers and file formats write for missing measurements."""
INTEGER_LIMITS = (
    *(-(2.0 ** (bits - 1)) for bits in (16, 24, 32, 64)),
    *(2.0 ** (bits - 1) - 1.0 for bits in (16, 24, 32, 64)),
    *(2.0**bits - 1.0 for bits in (16, 24, 32, 64)),
)
"""The least and largest integers of each type; a saturated A/D converter also gives them."""
HUGE = 9.9e36
"""Size above which a number is a fill value of a file format: 9.97e36, 9.9e37, 1e38, 3.4e38."""
LEAST_SAMPLES_BESIDE_CODES = 10
FAR_FROM_OTHER_VALUES = 50.0
"""Least distance of a code from the other values, in their robust spread. It is used if one of the
others is itself far away, so that their range is large."""
LEAST_VALUES_BESIDE_CODE, LEAST_VALUES_BESIDE_NUMBER = 10, 20
"""Least number of different other values, beside a code and beside any other number. A column with
fewer values has levels, such as a switch or a set point, and the number may be one of them."""
LEAST_REPETITIONS = 3
"""Least number of samples with a number (other than a code) that marks missing measurements."""
LONGEST_REPETITION = 10
"""Largest number of successive samples with such a number; a longer sequence is a real state."""
LARGEST_SHARE_OF_CODE = 0.5
"""Largest share of the samples with a code."""
LARGEST_SHARE_OF_NUMBER = 0.05
"""Largest share of the samples with another number that marks missing measurements."""
MOST_NAMED_RECORDS = 3


@dataclass(frozen=True)
class StandIn:
    """A number in a column that probably marks missing measurements.

    Attributes
    ----------
    value, count
        The number, and how often it occurs.
    samples
        Number of samples in the column.
    low, high
        The least and the largest of the other numbers.
    """

    value: float
    count: int
    samples: int
    low: float
    high: float


def is_missing(values: FloatArray, missing: Sequence[float]) -> npt.NDArray[np.bool_]:
    """Return a mask of the values that mark missing measurements.

    Numbers that were rounded to single precision are also recognised.

    Parameters
    ----------
    values : (n,)
        Values as in the file.
    missing
        Numbers that mark missing measurements.
    """
    with np.errstate(over="ignore"):
        rounded = np.asarray(missing, np.float64).astype(np.float32).astype(np.float64)
    return np.asarray(np.isin(values, [*missing, *rounded[np.isfinite(rounded)].tolist()]))


def stand_ins(values: FloatArray) -> tuple[StandIn, ...]:
    """Return the numbers of a column that probably mark missing measurements, the least first.

    A code (`NINES`, numbers above `HUGE`, `INTEGER_LIMITS`) is one if it is farther from all other
    values than their own range. Any other number must be the least or the largest value, and as
    far away. It must occur at least three times, each time only for a few samples, and there must
    be many different other values. A limit that the signal reaches without a gap (sensor
    saturation) and a level of a switch are never such numbers.

    Parameters
    ----------
    values : (n,)
        Values in the order of time; NaN for missing measurements.
    """
    known = values[np.isfinite(values)]
    if len(known) < LEAST_SAMPLES_BESIDE_CODES:
        return ()
    is_code = is_missing(known, (*NINES, *INTEGER_LIMITS)) | (np.abs(known) >= HUGE)
    found = list(_codes(known, is_code)) if is_code.any() else []
    rest = known[~np.isin(known, [each.value for each in found])] if found else known
    for value in (float(rest.min()), float(rest.max())):
        others = rest[rest != value]
        if _is_apart(rest, value, others):
            found.append(_stand_in(value, known, others))
    return tuple(sorted(found, key=lambda each: each.value))


def _codes(known: FloatArray, is_code: npt.NDArray[np.bool_]) -> Iterator[StandIn]:
    core = known[~is_code]
    if not len(core):
        return
    low, high = float(core.min()), float(core.max())
    spread = 1.4826 * float(np.median(np.abs(core - np.median(core))))
    written = is_missing(np.unique(known[is_code]), NINES)
    for value, nines in zip(np.unique(known[is_code]).tolist(), written.tolist(), strict=True):
        gap = max(low - value, value - high)
        near = high - low
        if nines and spread > 0.0:
            near = min(near, FAR_FROM_OTHER_VALUES * spread)
        if not gap > near or np.mean(known == value) > LARGEST_SHARE_OF_CODE:
            continue
        plain = abs(value) >= HUGE or (nines and value < 0.0 and gap > 0.5 * abs(value))
        if plain or len(np.unique(core)) >= LEAST_VALUES_BESIDE_CODE:
            yield _stand_in(value, known, core)


def _stand_in(value: float, known: FloatArray, others: FloatArray) -> StandIn:
    count = int(np.count_nonzero(known == value))
    return StandIn(value, count, len(known), float(others.min()), float(others.max()))


def _is_apart(values: FloatArray, value: float, others: FloatArray) -> bool:
    """Return whether a column with many different values jumps to a distant value at times."""
    count = len(values) - len(others)
    if (
        count < LEAST_REPETITIONS
        or count > LARGEST_SHARE_OF_NUMBER * len(values)
        or not len(others)
    ):
        return False
    gap = max(float(others.min()) - value, value - float(others.max()))
    if not gap > float(np.ptp(others)):
        return False
    there = np.concatenate([[False], values == value, [False]])
    edges = np.flatnonzero(there[1:] != there[:-1])
    longest = int((edges[1::2] - edges[::2]).max())
    at_an_end = bool(there[1] or there[-2])
    return (
        longest <= LONGEST_REPETITION
        and not at_an_end
        and len(np.unique(others)) >= LEAST_VALUES_BESIDE_NUMBER
    )


@dataclass(frozen=True)
class FoundStandIn:
    """A stand-in, and its place.

    Attributes
    ----------
    key
        Config key of the signal, such as "outputs.y".
    column
        Column of the table; "" if it is not known.
    experiment
        Id of the experiment.
    stand_in
        The number.
    """

    key: str
    column: str
    experiment: str
    stand_in: StandIn


def of_experiment(experiment: Experiment) -> tuple[FoundStandIn, ...]:
    """Return the stand-ins in the signals of an experiment without a known file."""
    signals = [(f"outputs.{each.variable}", each.values) for each in experiment.outputs]
    signals += [(f"inputs.{each.variable}", each.values) for each in experiment.inputs]
    signals += [(f"signals.{each.variable}", each.values) for each in experiment.signals]
    return tuple(
        FoundStandIn(key, "", experiment.id, each)
        for key, values in signals
        for each in stand_ins(values)
    )


def stand_in_findings(
    found: Sequence[FoundStandIn], missing: Sequence[float] = ()
) -> tuple[tuple[str, str], ...]:
    """Return texts on numbers that probably mark missing measurements, with advice.

    Parameters
    ----------
    found
        The stand-ins of all experiments.
    missing
        Numbers that are already left out.
    """
    groups: dict[tuple[str, float], list[FoundStandIn]] = {}
    for each in found:
        groups.setdefault((each.key, each.stand_in.value), []).append(each)
    values = sorted({*missing, *(each.stand_in.value for each in found)})
    listed = ", ".join(written(value) for value in values)
    read = any(each.column for each in found)
    key = f"missing = [{listed}] in [experiment_defaults], or in the experiment"
    if not read:
        key = f"missing=[{listed}] in Experiment.from_table"
    do = f"if nothing was measured there, leave these samples out with {key}"
    return tuple((_said(group), do) for group in groups.values())


def written(value: float) -> str:
    """Return a number in TOML notation, as it was before rounding to single precision."""
    with np.errstate(over="ignore"):
        single = float(np.float32(value)) == value
    text = str(np.float32(value)) if single else repr(value)
    return text.removesuffix(".0")


def _said(group: Sequence[FoundStandIn]) -> str:
    kind, name = group[0].key.split(".", 1)
    each = [found.stand_in for found in group]
    count, samples = sum(one.count for one in each), sum(one.samples for one in each)
    ids = list(dict.fromkeys(found.experiment for found in group))
    more = f" and {len(ids) - MOST_NAMED_RECORDS} more" if len(ids) > MOST_NAMED_RECORDS else ""
    runs = f"experiment{'s' if len(ids) > 1 else ''} {', '.join(ids[:MOST_NAMED_RECORDS])}{more}"
    columns = list(dict.fromkeys(found.column for found in group if found.column))
    of = f" of column {columns[0]!r}" if len(columns) == 1 else ""
    low, high = min(one.low for one in each), max(one.high for one in each)
    return (
        f"{kind[:-1]} {name} is {written(each[0].value)} in {count} of {samples} samples{of} in "
        f"{runs}, far from all other values, which are between {low:.4g} and {high:.4g}"
    )


def by_column(
    columns: Mapping[str, FloatArray], named: Sequence[tuple[str, str]], experiment: str
) -> tuple[FoundStandIn, ...]:
    """Return the stand-ins in the columns that an experiment uses.

    Parameters
    ----------
    columns
        Columns as in the file, by name.
    named
        Pairs (config key, column) of the experiment's signals.
    experiment
        Id of the experiment.
    """
    return tuple(
        FoundStandIn(key, column, experiment, each)
        for key, column in named
        for each in stand_ins(columns[column])
    )
