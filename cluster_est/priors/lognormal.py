"""The log-normal prior."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.priors.base import Prior
from workers.messages.checks import check_number

SMALLEST = 1e-300
"""Stands for a value of 0, at a lower bound: a search needs a finite residual there."""


@dataclass(frozen=True)
class LogNormalPrior(Prior):
    """A positive value that is known within a factor, such as a friction or a heat transfer.

    residual = ln(value / median) / ln(factor): 68 % of the probability lies between median / factor
    and median * factor. The density is that of the logarithm of the value, so that its mode is the
    median, whatever the parameter's scale is.

    Attributes
    ----------
    median
        In the parameter's unit.
    factor
        Above 1.
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
        return math.log(max(value, SMALLEST) / self.median) / math.log(self.factor)

    @override
    def slope(self, value: float) -> float:
        return 1.0 / (max(value, SMALLEST) * math.log(self.factor))

    @override
    def log_density(self, value: float) -> float:
        return -0.5 * self.residual(value) ** 2 - math.log(max(value, SMALLEST))

    @override
    def said(self) -> str:
        return f"lognormal, {self.median:g} within a factor of {self.factor:g}"

    @override
    def check(self, where: str, start: float, lower: float, upper: float) -> None:
        super().check(where, start, lower, upper)
        if not start > 0.0:
            raise ProblemError(
                f"{where}.start: must be above 0 with a log-normal prior, under which 0 is "
                f"impossible, but is {start:g}; start from the median {self.median:g}"
            )
        if not lower >= 0.0:
            raise ProblemError(
                f"{where}.bounds: must not be below 0 with a log-normal prior but begin at "
                f"{lower:g}; raise the lower bound"
            )
