"""Measured samples: arrays of floats, finite and in the order of time.

These checks are the same for arrays that are handed over and for columns of a file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.errors import DataError
from workers.messages.checks import shown
from workers.messages.types import FloatArray


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
        raise DataError(f"{where}: must hold numbers but cannot be read ({error})") from None
    if found.ndim != dimensions:
        alone = "a number alone" if found.dtype.kind in "iuf" else shown(values)
        shape = f"of shape {found.shape}" if found.ndim else alone
        must = "a list of numbers" if dimensions == 1 else "a table of numbers"
        raise DataError(f"{where}: must be {must} but is {shape}")
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
            f"{where}: must hold numbers but holds {values.dtype}; convert it to numbers "
            "(a time to seconds)"
        )
    for i, value in enumerate(values.flat):
        if isinstance(value, str):
            raise DataError(f"{where}[{i}]: must be a number but is {value!r}; mend it")
    try:
        return np.array(
            [np.nan if _absent(value) else float(value) for value in values.flat]
        ).reshape(values.shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: must hold numbers but does not ({error})") from None


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
            f"{where}, {place(i)}: the time must be a finite number but is "
            f"{times[i]}; remove the row or mend it"
        )
    forward = times[1:] > times[:-1]
    if not forward.all():
        i = int(np.flatnonzero(~forward)[0]) + 1
        how = "repeats" if times[i] == times[i - 1] else "goes back from"
        raise DataError(
            f"{where}, {place(i)}: times must increase but {times[i]:.9g} {how} "
            f"{times[i - 1]:.9g} of the row before; sort the rows and remove repeated ones"
        )


def check_length(values: FloatArray, times: FloatArray, where: str) -> None:
    """Refuse a signal that has not as many samples as there are times.

    Raises
    ------
    DataError
        With both numbers.
    """
    if len(values) != len(times):
        raise DataError(
            f"{where} must have as many rows as the time, {len(times)}, but has {len(values)}; "
            "choose another or mend it"
        )


def refuse_value(value: float, where: str, absent: str) -> DataError:
    """The error for a sample that is no finite number; `absent` says how one is left out."""
    return DataError(
        f"{where}: must be a finite number but is {value}; mend it, or {absent} where nothing "
        "was measured"
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
