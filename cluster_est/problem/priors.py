"""Priors: knowledge of a parameter before the measurements, which counts like a measurement.

A new prior is a subclass of `Prior` and a line in `PRIORS`, at the end.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.plug_in import check_class_attributes
from workers.messages.checks import check_number


class Prior(ABC):
    """Knowledge of a parameter before the measurements.

    A prior is a normal distribution of a function of the value. So it adds residual(value)^2 to a
    sum of squares, like a measurement of this function. Its derivatives need no simulation.

    A subclass is a frozen dataclass whose fields are the keys of a config.
    """

    name: ClassVar[str]
    """Name of the prior in a config."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @property
    @abstractmethod
    def centre(self) -> float:
        """The value with the largest density, in the parameter's unit."""

    @abstractmethod
    def residual(self, value: float) -> float:
        """Return the signed distance of a value from the centre, in standard deviations."""

    @abstractmethod
    def slope(self, value: float) -> float:
        """Return d residual / d value."""

    @abstractmethod
    def log_density(self, value: float) -> float:
        """Return ln p(value) up to a constant; p is the density of the value itself."""

    @abstractmethod
    def said(self) -> str:
        """Return the prior as a text for messages, such as "normal, 2 +- 0.1"."""

    def check(self, where: str, start: float, lower: float, upper: float) -> None:
        """Refuse a prior that contradicts the start value or the bounds of its parameter.

        Raises
        ------
        ProblemError
            If the prior contradicts the start value or the bounds.
        """
        del start  # subclasses may check it
        if not lower <= self.centre <= upper:
            raise ProblemError(
                f"{where}.prior: must have its centre within the bounds [{lower:g}, {upper:g}], "
                f"but is {self.said()}; change one of the two"
            )


@dataclass(frozen=True)
class NormalPrior(Prior):
    """A value that is known with a standard deviation, for example from a data sheet.

    residual = (value - mean) / sd. With bounds, the density is a truncated normal density. It
    differs by a constant factor, which does not change the minimum.

    Attributes
    ----------
    mean, sd
        Mean and standard deviation in the parameter's unit.
    """

    name: ClassVar[str] = "normal"

    mean: float
    sd: float

    def __post_init__(self) -> None:
        check_number(self.mean, "prior.mean", ProblemError)
        check_number(self.sd, "prior.sd", ProblemError, above=0.0)

    @property
    @override
    def centre(self) -> float:
        return self.mean

    @override
    def residual(self, value: float) -> float:
        return (value - self.mean) / self.sd

    @override
    def slope(self, value: float) -> float:
        return 1.0 / self.sd

    @override
    def log_density(self, value: float) -> float:
        return -0.5 * self.residual(value) ** 2

    @override
    def said(self) -> str:
        return f"normal, {self.mean:g} \u00b1 {self.sd:g}"


SMALLEST_PRIOR_VALUE = 1e-300
"""Replaces a value of 0 at a lower bound, because a search needs a finite residual there."""


@dataclass(frozen=True)
class LogNormalPrior(Prior):
    """A positive value that is known within a factor, such as a friction or a heat transfer.

    residual = ln(value / median) / ln(factor): 68 % of the probability lies between median / factor
    and median * factor. The density is that of the logarithm of the value. So its mode is the
    median, for every scale of the parameter.

    Attributes
    ----------
    median
        Median in the parameter's unit.
    factor
        Factor of one standard deviation; above 1.
    """

    name: ClassVar[str] = "lognormal"

    median: float
    factor: float

    def __post_init__(self) -> None:
        check_number(self.median, "prior.median", ProblemError, above=0.0)
        check_number(self.factor, "prior.factor", ProblemError, above=1.0)

    @property
    @override
    def centre(self) -> float:
        return self.median

    @override
    def residual(self, value: float) -> float:
        return math.log(max(value, SMALLEST_PRIOR_VALUE) / self.median) / math.log(self.factor)

    @override
    def slope(self, value: float) -> float:
        return 1.0 / (max(value, SMALLEST_PRIOR_VALUE) * math.log(self.factor))

    @override
    def log_density(self, value: float) -> float:
        return -0.5 * self.residual(value) ** 2 - math.log(max(value, SMALLEST_PRIOR_VALUE))

    @override
    def said(self) -> str:
        return f"lognormal, {self.median:g} within a factor of {self.factor:g}"

    @override
    def check(self, where: str, start: float, lower: float, upper: float) -> None:
        super().check(where, start, lower, upper)
        if not start > 0.0:
            raise ProblemError(
                f"{where}.start: must be above 0 with a log-normal prior, which gives 0 no "
                f"probability, but is {start:g}; start at the median {self.median:g}"
            )
        if not lower >= 0.0:
            raise ProblemError(
                f"{where}.bounds: must not be below 0 with a log-normal prior, but begin at "
                f"{lower:g}; raise the lower bound"
            )


PRIORS: dict[str, type[Prior]] = {
    NormalPrior.name: NormalPrior,
    LogNormalPrior.name: LogNormalPrior,
}

__all__ = ["PRIORS", "LogNormalPrior", "NormalPrior", "Prior"]
