"""Measured signals of an experiment: finite samples of inputs and outputs in the order of time.

The checks are the same for arrays that are handed over and for columns of a file.
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
    """Numbers as an array of floats; unchanged if they are one already.

    Parameters
    ----------
    values
        An array, a list, or a column of pandas, polars or pyarrow.
    where
        Opens the message.
    dimensions
        Of the array.

    Raises
    ------
    DataError
        If something in it is not a number.
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
    """Numbers as an array of floats that nobody can change: a copy, unless they are one already.

    For what is kept: an array that its owner fills with the next measurement must not change the
    last one.

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
    """Numbers in an array of Python objects, NaN for None and the like."""
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
    """True for what stands for no measurement: None, or NA of pandas."""
    return value is None or type(value).__name__ in ("NAType", "NaTType")


def check_times(times: FloatArray, where: str, place: Callable[[int], str]) -> None:
    """Refuse times that are not finite and strictly increasing, naming the first bad one.

    Parameters
    ----------
    times
        In seconds.
    where
        Opens the message.
    place
        The place of an index, such as "row 5".

    Raises
    ------
    DataError
        If there is a bad one.
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
            f"{times[i - 1]:.9g} in the row before; {_remedy(times)}"
        )


COARSE = 0.1
"""Share of the rows that have the time of the row before, from which on it is the clock."""


def _remedy(times: FloatArray) -> str:
    """Return what to do with times that do not increase."""
    steps = np.diff(times)
    if np.mean(steps == 0.0) > COARSE:
        return (
            "many rows have the same time, so give sample_time, the seconds between rows, instead "
            "of time"
        )
    if np.all(steps < 0.0):
        return "reverse the order of the rows"
    return "sort the rows and remove repeated ones"


def check_length(values: FloatArray, times: FloatArray, where: str) -> None:
    """Refuse a signal that has not as many samples as there are times.

    Raises
    ------
    DataError
        With both numbers.
    """
    if len(values) != len(times):
        raise DataError(
            f"{where} must have as many rows as the time column, {len(times)}, but has "
            f"{len(values)}; choose another column or correct it"
        )


def refuse_value(value: float, where: str, absent: str) -> DataError:
    """The error for a sample that is no finite number; `absent` says how one is left out."""
    return DataError(
        f"{where}: must be a finite number, but is {value}; correct it, or {absent} if nothing was "
        "measured"
    )


def check_finite(values: FloatArray, where: str) -> None:
    """Refuse samples that are not finite.

    Raises
    ------
    DataError
        Naming the first.
    """
    if not np.isfinite(values).all():
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        raise refuse_value(float(values[i]), f"{where}, index {i}", "leave the sample out")


@by_content
@dataclass(frozen=True)
class Input:
    """A measured signal that drives an input variable of the FMU.

    Before its first and after its last sample the signal keeps that sample's value. Times and
    values may be given as arrays, lists or columns of a table.

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
        The output of the FMU, when it was measured, in seconds, and what was measured.
    sigma
        Standard deviation of the noise, in the signal's unit; 1 where it is not given.
    relative_sigma
        Of a sensor or an assay whose noise grows with what it measures: the part of each measured
        value that its noise has besides `sigma`.
    free_scale, free_offset
        Whether what is simulated may be multiplied by any factor, and shifted by any amount, before
        it is compared: the best ones, in each experiment.
    detection_limit
        Measured values at or below it say no more than that; None without a limit.
    ordinal
        Whether the measured values say an order and nothing else, such as grades from 1 to 5: equal
        values are one category, and a larger value says that the output was larger. `sigma` is then
        in standard deviations of the simulated signal.
    noise_factors : (n,)
        What the standard deviation of each sample is multiplied by: that of a value made of many
        samples is smaller. None for 1.
    reference
        Of a held-out part of a record the same output in the training part: scale, offset and the
        bounds of categories are found from it alone. None where they are found from the output
        itself.

    Raises
    ------
    DataError
        If times are not finite and increasing, values not finite, or sigma not positive, or what it
        is compared by contradicts itself.
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

    def __post_init__(self) -> None:
        where = _check_samples(self, "output")
        check_flag(self.free_scale, f"{where}.free_scale", DataError)
        check_flag(self.free_offset, f"{where}.free_offset", DataError)
        check_flag(self.ordinal, f"{where}.ordinal", DataError)
        if self.detection_limit is not None:
            check_number(self.detection_limit, f"{where}.detection_limit", DataError)
            hidden = kept_floats(np.maximum(self.values, self.detection_limit), f"{where}.values")
            object.__setattr__(self, "values", hidden)  # 0 and the limit say the same
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
        """Refuse what an order says nothing of."""
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

        Times its noise factor.
        """
        if self.relative_sigma == 0.0:
            found = np.full(len(self.times), self.sigma)
        else:
            found = np.hypot(self.sigma, self.relative_sigma * self.values)
        return found if self.noise_factors is None else found * self.noise_factors

    def only(self, kept: npt.NDArray[np.bool_] | IntArray) -> Output:
        """Return the output with these of its samples alone."""
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
        """Whether its residuals are those after something was fitted to what was measured."""
        return self.free_scale or self.free_offset or self.ordinal

    @property
    def is_hidden(self) -> npt.NDArray[np.bool_]:
        """(n,): whether each value is at its detection limit, and says no more than that."""
        if self.detection_limit is None:
            return np.zeros(len(self.times), np.bool_)
        return self.values <= self.detection_limit

    @property
    def has_sigma(self) -> bool:
        """Whether its noise is given: a sigma of 1 is what stands where it is not."""
        return self.sigma != 1.0 or self.relative_sigma > 0.0


def _check_samples(signal: Any, kind: str) -> str:
    """Make times and values arrays, and refuse what is no measurement.

    Returns
    -------
    str
        The opening of messages about this signal.
    """
    check_name(signal.variable, f"{kind}.variable", DataError)
    where = f"{kind} {signal.variable!r}"
    times = kept_floats(signal.times, f"{where}.times")
    values = kept_floats(signal.values, f"{where}.values")
    object.__setattr__(signal, "times", times)  # a frozen class is changed while it is made alone
    object.__setattr__(signal, "values", values)
    check_length(values, times, f"{where}.values:")
    check_times(times, f"{where}.times", "index {}".format)
    check_finite(values, f"{where}.values")
    return where
