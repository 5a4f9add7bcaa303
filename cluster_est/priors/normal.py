"""The normal prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.priors.base import Prior
from workers.messages.checks import check_number


@dataclass(frozen=True)
class NormalPrior(Prior):
    """A value that is known within a standard deviation, as from a data sheet.

    residual = (value - mean) / sd. Between the bounds alone it is a truncated normal density; the
    constant by which that differs does not move the minimum.

    Attributes
    ----------
    mean, sd
        In the parameter's unit.
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
