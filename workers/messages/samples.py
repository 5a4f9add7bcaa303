"""Measured signals of an experiment: inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass, field
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
)
from workers.messages.equality import by_content
from workers.messages.signals import check_finite, check_length, check_times, kept_floats
from workers.messages.types import FloatArray, Interpolation


@by_content
@dataclass(frozen=True)
class Input:
    """A measured signal that drives an input variable of the FMU.

    Before its first and after its last sample the signal keeps that sample's value. Times and
    values may be given as arrays, lists or columns of a table.

    Raises
    ------
    DataError
        If times are not finite and increasing, or values not finite, or there are none.
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
                f"{where}: must have at least one sample but has none; leave the input out if "
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
        Measured values at or below it say no more than that; None where there is none.
    ordinal
        Whether the measured values say an order and nothing else, such as grades from 1 to 5: equal
        values are one category, and a larger value says that the output was larger. `sigma` is then
        in standard deviations of the simulated signal.
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
                    f"{where}.detection_limit: must not go with free_scale or free_offset, whose "
                    "values would depend on what was not measured; remove one of the two"
                )
        check_number(self.sigma, f"{where}.sigma", DataError, above=0.0)
        check_number(self.relative_sigma, f"{where}.relative_sigma", DataError, least=0.0)
        if self.ordinal:
            self._check_ordinal(where)
        if self.reference is not None:
            check_kind(self.reference, Output, f"{where}.reference", DataError)
            if self.reference.variable != self.variable or not len(self.reference.times):
                raise DataError(
                    f"{where}.reference: must be the same output with at least one measured value "
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
                    f"{where}.ordinal: must not go with {key}, for an order says nothing of sizes, "
                    "but both are given; remove one of the two"
                )

    @property
    def sigmas(self) -> FloatArray:
        """The standard deviation of each sample, sqrt(sigma^2 + (relative_sigma value)^2)."""
        if self.relative_sigma == 0.0:
            return np.full(len(self.times), self.sigma)
        return np.hypot(self.sigma, self.relative_sigma * self.values)

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
