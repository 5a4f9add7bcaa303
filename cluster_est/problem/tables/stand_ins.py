"""Numbers that stand for no measurement: -9999, 65535, 9.9e37 among values of another size.

Loggers write them where a sensor gave nothing. A fit that takes them for measurements follows them
and nothing else.
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
"""What loggers and file formats write where nothing was measured."""
INTEGER_LIMITS = (
    *(-(2.0 ** (bits - 1)) for bits in (16, 24, 32, 64)),
    *(2.0 ** (bits - 1) - 1.0 for bits in (16, 24, 32, 64)),
    *(2.0**bits - 1.0 for bits in (16, 24, 32, 64)),
)
"""The least and largest integers of a type. A converter that is at its end gives them too."""
HUGE = 9.9e36
"""Sizes from which on a number is the filling of a file format: 9.97e36, 9.9e37, 1e38, 3.4e38."""
LEAST_SAMPLES_BESIDE_CODES = 10
FAR_FROM_OTHER_VALUES = 50.0
"""Distance of a written code from the others, in their robust spread, where one of them is far off
itself, so that they have a large range."""
LEAST_VALUES_BESIDE_CODE, LEAST_VALUES_BESIDE_NUMBER = 10, 20
"""Different values that the others must have: below, the column is one of levels, such as a switch
or a set point, and its last level is one of these. The first is for codes, the second for any
number."""
LEAST_REPETITIONS = 3
"""Least number of samples that say of any number that it stands for no measurement."""
LONGEST_REPETITION = 10
"""Samples in a row of any number; longer ones are a state."""
LARGEST_SHARE_OF_CODE = 0.5
"""Largest share of the samples that a written code may have."""
LARGEST_SHARE_OF_NUMBER = 0.05
"""Largest share of the samples that any other number may have, if it stands for no measurement."""
MOST_NAMED_RECORDS = 3


@dataclass(frozen=True)
class StandIn:
    """A number of a column that is apart from all others.

    Attributes
    ----------
    value, count
        The number, and how often it is there.
    samples
        Of the column.
    low, high
        The least and the largest of the other numbers.
    """

    value: float
    count: int
    samples: int
    low: float
    high: float


def is_missing(values: FloatArray, missing: Sequence[float]) -> npt.NDArray[np.bool_]:
    """Return which values stand for no measurement; single precision has rounded some of them.

    Parameters
    ----------
    values : (n,)
        As they are in the file.
    missing
        Numbers that mean that nothing was measured.
    """
    with np.errstate(over="ignore"):
        rounded = np.asarray(missing, np.float64).astype(np.float32).astype(np.float64)
    return np.asarray(np.isin(values, [*missing, *rounded[np.isfinite(rounded)].tolist()]))


def stand_ins(values: FloatArray) -> tuple[StandIn, ...]:
    """Return the numbers of a column that hardly are measurements, the least first.

    A code (`NINES`, numbers from `HUGE` on, `INTEGER_LIMITS`) is one if it lies farther from all
    other values than their own range. So is any number that is the least or the largest of the
    column, is there at least three times, each time for a few samples, and lies as far off, if the
    others are many and different. Where a signal ends at a limit without a gap, as of a sensor in
    saturation, or has levels alone, as a switch, no number stands for a missing one.

    Parameters
    ----------
    values : (n,)
        In the order of time; NaN where nothing was measured.
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
    """Return whether a column leaves many different values for one far off, now and then."""
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
    """A stand-in, and where it is.

    Attributes
    ----------
    key
        Of the config, such as "outputs.y".
    column
        Of the table; empty if it is not known.
    experiment
        Its id.
    stand_in
        The number.
    """

    key: str
    column: str
    experiment: str
    stand_in: StandIn


def of_experiment(experiment: Experiment) -> tuple[FoundStandIn, ...]:
    """Return the stand-ins in the signals of an experiment that was read from no known file."""
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
    """Say which numbers are hardly measurements, and what leaves them out.

    Parameters
    ----------
    found
        In all experiments.
    missing
        What is left out already.
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
    """Return a number as it is written in TOML, before single precision rounded it."""
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
        As they are in the file, by name.
    named
        (key of the config, column) of its signals.
    experiment
        Its id.
    """
    return tuple(
        FoundStandIn(key, column, experiment, each)
        for key, column in named
        for each in stand_ins(columns[column])
    )
