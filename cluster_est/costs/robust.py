"""Costs that grow more slowly than squares: for data with outliers.

All are F = sum of s^2 rho((e / s)^2), where s is the scale beyond which a residual is an outlier,
and rho(z) = z near 0, so that small residuals count as in the sum of squares. Least-squares methods
see the weight rho'(z): P. J. Huber, Robust Statistics (1981), doi:10.1002/0471725250, section 7.8;
the forms are those of B. Triggs et al., Bundle Adjustment (2000), doi:10.1007/3-540-44480-7_21.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class _RobustCost(Cost):
    """A robust cost; its subclasses define rho."""

    scale: float = field(default=1.0, metadata={"least": 1e-100})

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        with np.errstate(over="ignore"):
            z = (np.ascontiguousarray(residuals) / self.scale) ** 2
            return float(self.scale**2 * np.add.reduce(self._rho(z)))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        with np.errstate(over="ignore"):
            return self._rho_derivative((residuals / self.scale) ** 2)

    @abstractmethod
    def _rho(self, z: FloatArray) -> FloatArray: ...

    @abstractmethod
    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        """Return d rho / dz."""


@dataclass(frozen=True)
class HuberCost(_RobustCost):
    """Squares up to `scale`, from there on a straight line: rho(z) = z, then 2 sqrt(z) - 1.

    The first robust cost to try: it has one minimum where the sum of squares has one.

    Attributes
    ----------
    scale
        In units of sigma (of the output, where no sigma is given). 1.345 sigma loses 5 % of the
        precision of the sum of squares where there are no outliers.
    """

    name: ClassVar[str] = "huber"

    def _rho(self, z: FloatArray) -> FloatArray:
        return np.asarray(np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0))

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / np.sqrt(np.maximum(z, 1.0))


@dataclass(frozen=True)
class SoftL1(_RobustCost):
    """A smooth passage from squares to absolute values: rho(z) = 2 (sqrt(1 + z) - 1).

    Attributes
    ----------
    scale
        In units of sigma (of the output, where no sigma is given).
    """

    name: ClassVar[str] = "soft_l1"

    def _rho(self, z: FloatArray) -> FloatArray:
        # the same as 2 (sqrt(1 + z) - 1), without losing the digits of a small z
        finite = np.minimum(z, np.finfo(float).max)
        return np.where(z <= finite, 2.0 * finite / (np.sqrt(1.0 + finite) + 1.0), np.inf)

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / np.sqrt(1.0 + z)


@dataclass(frozen=True)
class CauchyCost(_RobustCost):
    """Large residuals hardly count: rho(z) = ln(1 + z).

    For gross outliers. It may have several minima: start close, or from several starts.

    Attributes
    ----------
    scale
        In units of sigma (of the output, where no sigma is given).
    """

    name: ClassVar[str] = "cauchy"

    def _rho(self, z: FloatArray) -> FloatArray:
        return np.asarray(np.log1p(z))

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / (1.0 + z)
