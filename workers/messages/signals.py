"""Measured signals of an experiment: finite samples of inputs and outputs in temporal order.

The checks are the same for arrays given in Python and for columns of a file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from workers.errors import DataError
from workers.messages.checks import (
    check_choice,
    check_flag,
    check_kind,
    check_name,
    check_number,
    shown,
)
from workers.messages.types import FloatArray, IntArray, Interpolation, by_content


def as_floats(values: Any, where: str, dimensions: int = 1) -> FloatArray:
    """Return numbers as an array of floats; such an array is returned unchanged.

    Parameters
    ----------
    values
        An array, a list, or a column of pandas, polars or pyarrow.
    where
        Start of the error message.
    dimensions
        Number of dimensions of the array.

    Raises
    ------
    DataError
        If an element is not a number.
    """
    if type(values) is np.ndarray and values.dtype == np.float64 and values.ndim == dimensions:
        return values
    try:
        found = np.ma.filled(values.astype(float), np.nan) if np.ma.isMaskedArray(values) else None
        found = np.asarray(values) if found is None else found
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: must contain numbers, but cannot be read ({error})") from None
    if found.ndim != dimensions:
        alone = "a single number" if found.dtype.kind in "iuf" else shown(values)
        shape = f"of shape {found.shape}" if found.ndim else alone
        must = "a list of numbers" if dimensions == 1 else "a table of numbers"
        raise DataError(f"{where}: must be {must}, but is {shape}")
    if found.dtype.kind not in "biuf" and found.size:
        found = _from_objects(found, where)
    return np.asarray(found, np.float64)


def kept_floats(values: Any, where: str, dimensions: int = 1) -> FloatArray:
    """Return numbers as a read-only array of floats: a copy, unless they already are one.

    This protects kept data, because the caller may write the next measurement to the same array.

    Raises
    ------
    DataError
        As `as_floats`.
    """
    found = as_floats(values, where, dimensions)
    if found.flags.writeable or found.base is not None:
        found = found.copy()
        found.flags.writeable = False
    return found


def _from_objects(values: Any, where: str) -> Any:
    """Convert an array of Python objects to numbers, with NaN for None and similar values."""
    if values.dtype.kind != "O":
        raise DataError(
            f"{where}: must contain numbers, but contains {values.dtype}; convert it to numbers (a "
            "time to seconds)"
        )
    for i, value in enumerate(values.flat):
        if isinstance(value, str):
            raise DataError(f"{where}[{i}]: must be a number, but is {value!r}; correct it")
    try:
        return np.array(
            [np.nan if _absent(value) else float(value) for value in values.flat]
        ).reshape(values.shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: must contain numbers, but does not ({error})") from None


def _absent(value: object) -> bool:
    """Return whether a value means "not measured": None, or NA of pandas."""
    return value is None or type(value).__name__ in ("NAType", "NaTType")


def check_times(
    times: FloatArray, where: str, place: Callable[[int], str], *, of_rows: bool = False
) -> None:
    """Check that times are finite and strictly increasing.

    Parameters
    ----------
    times
        In seconds.
    where
        Start of the error message.
    place
        Converts an index to a place, such as "row 5".
    of_rows
        Whether they are the times of a file's rows, which the keys `sample_time` and `rows` change.

    Raises
    ------
    DataError
        If they are not. The message names the first wrong time.
    """
    if not np.isfinite(times).all():
        i = int(np.flatnonzero(~np.isfinite(times))[0])
        raise DataError(
            f"{where}, {place(i)}: the time must be a finite number, but is {times[i]}; remove the "
            "row or correct it"
        )
    forward = times[1:] > times[:-1]
    if not forward.all():
        i = int(np.flatnonzero(~forward)[0]) + 1
        how = "repeats" if times[i] == times[i - 1] else "goes back from"
        raise DataError(
            f"{where}, {place(i)}: times must increase, but {times[i]:.9g} {how} "
            f"{times[i - 1]:.9g} in the row before; {_remedy(times, place, of_rows)}"
        )


COARSE = 0.1
"""Share of rows with the time of the previous row above which the clock is too coarse."""
ROWS_IN_ORDER = 10
"""Least mean number of rows between two steps back, if the rows are not simply unsorted."""
ROWS_APART = 0.75
"""Least step of sorted rows, in their least step before, if no part is sorted into another."""
LONG_STEP = 5.0
"""Length of a step, in usual steps, above which rows may be missing."""
MOST_WRONG = 1000
"""Largest number of successive rows whose times alone may be wrong."""
EVEN_PACE = 0.25
"""Relative error of the time that passes over such rows. If one row were there twice, or in a wrong
place, one step instead of two would pass over it, an error of a half."""


def _remedy(times: FloatArray, place: Callable[[int], str], of_rows: bool) -> str:
    """Return advice for times that do not increase."""
    steps = np.diff(times)
    if np.mean(steps == 0.0) > COARSE:
        return "many rows have the same time, so " + (
            "give sample_time, the seconds between rows, instead of time"
            if of_rows
            else "correct the times"
        )
    if np.all(steps <= 0.0):
        return "reverse the order of the rows"
    back = np.flatnonzero(steps < 0.0)
    if not len(back):
        return "remove the repeated rows"
    usual = float(np.median(steps))
    wrong = _wrong_times(times, back, usual)
    if wrong:
        many = f" (and of {len(wrong) - 1} more rows)" if len(wrong) > 1 else ""
        return (
            f"all other times fit together, so the time of {place(wrong[0])}{many} is wrong, "
            f"{times[wrong[0]]:.9g}: correct it, or remove the row"
        )
    runs = np.split(times, back + 1)
    once = np.sort(times[np.r_[True, steps != 0.0]])
    mixed = np.diff(once).min() < ROWS_APART * steps[steps > 0.0].min()
    if not mixed or len(runs) * ROWS_IN_ORDER > len(times):
        return "sort the rows and remove repeated ones"
    if all(abs(float(run[0]) - float(times[0])) <= 2.0 * usual for run in runs):
        return _of_tests(of_rows)
    return _of_clock(steps, usual - float(steps[back[0]]), of_rows)


def _wrong_times(times: FloatArray, back: IntArray, usual: float) -> list[int]:
    """Return the rows whose times are wrong, if without them every step back is gone.

    Over these rows, about as much time must pass as over other rows. It does not if a clock was set
    back, or if another test begins. A single first or last row cannot be a test either.
    """
    found: list[int] = []
    for i in (back + 1).tolist():
        later = times[i + 1 : i + 1 + MOST_WRONG] > times[i - 1]
        earlier = times[max(i - 1 - MOST_WRONG, 0) : i - 1][::-1] < times[i]
        ends = [(i - 1, i + 1 + int(np.argmax(later)))] if later.any() else []
        ends += [(i - 2 - int(np.argmax(earlier)), i)] if earlier.any() else []
        rows = [
            range(first + 1, last)
            for first, last in ends
            if abs(times[last] - times[first] - (last - first) * usual)
            <= EVEN_PACE * (last - first) * usual
        ]
        rows += [range(1)] if i == 1 else []
        rows += [range(i, i + 1)] if i == len(times) - 1 else []
        if not rows:
            return []
        shortest: range = min(rows, key=len)
        found += shortest
    return sorted(set(found))


def _of_tests(of_rows: bool) -> str:
    """Return advice for times that begin again."""
    how = (
        ' with rows = [FROM, TO], or use split_by = "COLUMN" if a column names the test of each '
        "row; if all rows belong to one test, and only its counter began again, give sample_time "
        "instead of time"
    )
    return (
        "the time begins again there, as in a file with several tests; make an experiment of each "
        f"test{how if of_rows else ''}"
    )


def _of_clock(steps: FloatArray, amount: float, of_rows: bool) -> str:
    """Return advice for a clock that was set back: sorting would mix two parts of the record."""
    even = even_step(steps)
    said, cure = "are in order", f"add {amount:.6g} to the times from there on"
    if steps.max() > LONG_STEP * np.median(steps):
        cure = "correct the times there"
    elif even and of_rows:
        said = f"are {even:.6g} s apart"
        cure = f"give sample_time = {even:.6g}, the seconds between rows, instead of time"
    return (
        f"the rows before and after it {said}, so the clock was set back by about {amount:.6g} s; "
        f"do not sort the rows, but {cure} (only if these rows repeat earlier rows with all their "
        "values, remove them)"
    )


def even_step(steps: FloatArray) -> float:
    """Return the seconds between evenly spaced rows; 0 if the spacing is uneven.

    Steps back and long steps are ignored. Without them, no time may be further from a straight line
    than half a step.
    """
    usual = float(np.median(steps)) if len(steps) else 0.0
    plain = (steps > 0.0) & (steps <= LONG_STEP * usual)
    if not plain.any():
        return 0.0
    mean = float(np.mean(steps[plain]))
    drift = np.cumsum(np.where(plain, steps - mean, 0.0))
    return mean if np.max(np.abs(drift)) <= 0.5 * mean else 0.0


def check_length(values: FloatArray, times: FloatArray, where: str) -> None:
    """Check that a signal has as many samples as there are times.

    Raises
    ------
    DataError
        If it does not. The message contains both numbers.
    """
    if len(values) != len(times):
        raise DataError(
            f"{where} must have as many rows as the time column, {len(times)}, but has "
            f"{len(values)}; choose another column or correct it"
        )


def refuse_value(value: float, where: str, absent: str) -> DataError:
    """Return the error for a sample that is not finite; `absent` describes how to omit it."""
    return DataError(
        f"{where}: must be a finite number, but is {value}; correct it, or {absent} if nothing was "
        "measured"
    )


def check_finite(values: FloatArray, where: str) -> None:
    """Check that all samples are finite.

    Raises
    ------
    DataError
        If they are not. The message names the first wrong sample.
    """
    if not np.isfinite(values).all():
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        raise refuse_value(float(values[i]), f"{where}, index {i}", "leave the sample out")


@by_content
@dataclass(frozen=True)
class Input:
    """A measured signal that drives an input variable of the FMU.

    Before the first and after the last sample, the signal is constant. Times and values may be
    given as arrays, lists or columns of a table.

    Raises
    ------
    DataError
        If times are not finite and increasing, or values not finite, or both are empty.
    """

    variable: str
    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)
    interpolation: Interpolation = "linear"

    def __post_init__(self) -> None:
        where = _check_samples(self, "input")
        check_choice(
            self.interpolation, get_args(Interpolation), f"{where}.interpolation", DataError
        )
        if not len(self.times):
            raise DataError(
                f"{where}: must have at least one sample, but has none; leave the input out if "
                "nothing was measured"
            )


@by_content
@dataclass(frozen=True)
class Output:
    """A measured signal that an output variable of the FMU should follow.

    Times and values may be given as arrays, lists or columns of a table.

    Attributes
    ----------
    variable, times, values
        The output of the FMU, the times of its measurement in seconds, and the measured values.
    sigma
        Standard deviation of the noise, in the signal's unit; 1 if it is not given.
    relative_sigma
        For a sensor or an assay whose noise increases with the measured value: the standard
        deviation of additional noise, relative to each measured value.
    free_scale, free_offset
        Whether the simulated signal is multiplied by a free factor, and shifted by a free offset,
        before the comparison. The best values are used in each experiment.
    detection_limit
        Measured values at or below it are censored; None without a limit.
    ordinal
        Whether only the order of the measured values counts, such as grades from 1 to 5. Equal
        values form a category, and a larger value means that the output was larger. Then `sigma` is
        in standard deviations of the simulated signal.
    sigma_known
        Whether sigma is the known noise of the sensor. If not, it only weights the output.
    noise_factors : (n,)
        Factors of the standard deviation of each sample, which is smaller for the mean of many
        samples. None for 1.
    reference
        For a held-out part of a record, the same output in the training part. Scale, offset and
        category bounds are estimated only from it. None if they are estimated from the output
        itself.

    Raises
    ------
    DataError
        If times are not finite and increasing, values not finite, or sigma not positive, or if the
        options of the comparison contradict each other.
    """

    variable: str
    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)
    sigma: float = 1.0
    relative_sigma: float = 0.0
    free_scale: bool = False
    free_offset: bool = False
    detection_limit: float | None = None
    ordinal: bool = False
    reference: Output | None = field(default=None, repr=False)
    noise_factors: FloatArray | None = field(default=None, repr=False)
    sigma_known: bool = True

    def __post_init__(self) -> None:
        where = _check_samples(self, "output")
        check_flag(self.sigma_known, f"{where}.sigma_known", DataError)
        check_flag(self.free_scale, f"{where}.free_scale", DataError)
        check_flag(self.free_offset, f"{where}.free_offset", DataError)
        check_flag(self.ordinal, f"{where}.ordinal", DataError)
        if self.detection_limit is not None:
            check_number(self.detection_limit, f"{where}.detection_limit", DataError)
            hidden = kept_floats(np.maximum(self.values, self.detection_limit), f"{where}.values")
            object.__setattr__(self, "values", hidden)  # values below the limit are equivalent
            if self.free_scale or self.free_offset:
                raise DataError(
                    f"{where}.detection_limit: must not be used with free_scale or free_offset, "
                    "which would then depend on values that were not measured; remove one of the "
                    "two"
                )
        check_number(self.sigma, f"{where}.sigma", DataError, above=0.0)
        check_number(self.relative_sigma, f"{where}.relative_sigma", DataError, least=0.0)
        if self.noise_factors is not None:
            factors = kept_floats(self.noise_factors, f"{where}.noise_factors")
            check_length(factors, self.times, f"{where}.noise_factors:")
            object.__setattr__(self, "noise_factors", factors)
        if self.ordinal:
            self._check_ordinal(where)
        if self.reference is not None:
            check_kind(self.reference, Output, f"{where}.reference", DataError)
            if self.reference.variable != self.variable or not len(self.reference.times):
                raise DataError(
                    f"{where}.reference: must be the same output with at least one measured value, "
                    f"but is {self.reference.variable!r} with {len(self.reference.times)}; leave "
                    "it out"
                )

    def _check_ordinal(self, where: str) -> None:
        """Check that no option is given that contradicts ordinal values."""
        given = {
            "free_scale": self.free_scale,
            "free_offset": self.free_offset,
            "detection_limit": self.detection_limit is not None,
            "relative_sigma": self.relative_sigma > 0.0,
        }
        for key, there in given.items():
            if there:
                raise DataError(
                    f"{where}.ordinal: must not be used with {key} (only the order of ordinal "
                    "values counts), but both are given; remove one of the two"
                )

    @property
    def sigmas(self) -> FloatArray:
        """The standard deviation of each sample, sqrt(sigma^2 + (relative_sigma value)^2).

        It is multiplied by the sample's noise factor.
        """
        if self.relative_sigma == 0.0:
            found = np.full(len(self.times), self.sigma)
        else:
            found = np.hypot(self.sigma, self.relative_sigma * self.values)
        return found if self.noise_factors is None else found * self.noise_factors

    def only(self, kept: npt.NDArray[np.bool_] | IntArray) -> Output:
        """Return the output with only these samples."""
        factors = self.noise_factors
        return replace(
            self,
            times=self.times[kept],
            values=self.values[kept],
            noise_factors=None if factors is None else factors[kept],
        )

    @property
    def is_plain(self) -> bool:
        """Whether its residuals are (measured - simulated) / sigma."""
        free = self.free_scale or self.free_offset
        return not (free or self.ordinal) and self.detection_limit is None

    @property
    def learns(self) -> bool:
        """Whether scale, offset or category bounds are fitted before its residuals are computed."""
        return self.free_scale or self.free_offset or self.ordinal

    @property
    def is_hidden(self) -> npt.NDArray[np.bool_]:
        """(n,): whether each value is at its detection limit, and so is censored."""
        if self.detection_limit is None:
            return np.zeros(len(self.times), np.bool_)
        return self.values <= self.detection_limit

    @property
    def has_sigma(self) -> bool:
        """Whether its noise is given; it is not if sigma is 1 or not known."""
        return self.sigma_known and (self.sigma != 1.0 or self.relative_sigma > 0.0)


def _check_samples(signal: Any, kind: str) -> str:
    """Convert times and values to arrays, and check them.

    Returns
    -------
    str
        The start of messages about this signal.
    """
    check_name(signal.variable, f"{kind}.variable", DataError)
    where = f"{kind} {signal.variable!r}"
    times = kept_floats(signal.times, f"{where}.times")
    values = kept_floats(signal.values, f"{where}.values")
    object.__setattr__(signal, "times", times)  # allowed in __post_init__ only
    object.__setattr__(signal, "values", values)
    check_length(values, times, f"{where}.values:")
    check_times(times, f"{where}.times", "index {}".format)
    check_finite(values, f"{where}.values")
    return where
