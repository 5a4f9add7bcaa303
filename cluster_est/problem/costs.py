"""Costs: functions from the residuals of all experiments to one number.

A new cost is a subclass of `Cost` and a line in `COSTS`, at the end.

Robust costs, for data with outliers, grow more slowly than squares. All of them are
F = sum of s^2 rho((e / s)^2). Residuals above the scale s are outliers. Near 0, rho(z) = z, so
small residuals count as in the sum of squares. Least-squares methods use the weight rho'(z) (P. J.
Huber, Robust Statistics (1981), doi:10.1002/0471725250, section 7.8). The functions rho are those
of B. Triggs et al., Bundle Adjustment (2000), doi:10.1007/3-540-44480-7_21.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.plug_in import check_class_attributes
from workers.messages import FloatArray, IntArray, Reduction


class Cost(ABC):
    """Computes one number F from the residuals of all experiments; its attributes are its options.

    `outputs` contains the index of each residual's output, counted from 0, with the same index in
    all experiments. It is empty if the outputs are not known, for example if a Python function
    returns the residuals; all residuals then count as one output. Costs that treat all residuals
    in the same way need not use it.
    """

    name: ClassVar[str]
    """Its name in a config."""

    reduction: ClassVar[Reduction | None] = None
    """A number that may replace the residuals of an output in an experiment without changing
    `value`. None for a cost that needs each residual, as most costs do."""

    is_logarithm: ClassVar[bool] = False
    """Whether the cost is the logarithm of a quantity with a unit, such as a log likelihood."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @abstractmethod
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        """Return the cost of all residuals (n,) at one point.

        The cost does not depend on the order of the residuals. It is 0 if there are none, as in a
        search for a point that satisfies constraints.
        """

    @abstractmethod
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        """Return the weights of the residuals' squares for a least-squares method at this point.

        With weights w (n,), the gradient of F with respect to the residuals is 2 w r. So sqrt(w) r
        and sqrt(w) J give the right gradient. If the curvature of F is at most that of the squares,
        they also give a step that decreases F. None if the cost cannot be used in this way.
        """


@dataclass(frozen=True)
class SumSquared(Cost):
    """F = sum of e(t)^2 over all outputs of all experiments.

    This is the default. It gives the maximum-likelihood estimate if the noise is normal with the
    standard deviation `sigma`.
    """

    name: ClassVar[str] = "sse"
    reduction: ClassVar[Reduction | None] = "squares"

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        # not a dot product, whose rounding depends on the number of threads of the BLAS library
        with np.errstate(over="ignore"):  # an infinite cost is refused like any high cost
            return float(np.add.reduce(residuals * residuals))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return np.ones_like(residuals)


@dataclass(frozen=True)
class SumAbsolute(Cost):
    """F = sum of |e(t)| over all outputs of all experiments.

    Use it for data with outliers, if a few large residuals must not dominate. It has a kink where a
    residual is 0, so use a method without gradients, such as `pattern_search` or `nelder_mead`.
    `huber` with a small `scale` is almost the same, and smooth.
    """

    name: ClassVar[str] = "sae"
    reduction: ClassVar[Reduction | None] = "absolutes"

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        with np.errstate(over="ignore"):
            return float(np.add.reduce(np.abs(np.ascontiguousarray(residuals))))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return None


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
    """Quadratic up to `scale`, and linear above it: rho(z) = z, then 2 sqrt(z) - 1.

    This is the first robust cost to try: it has one minimum if the sum of squares has one.

    Attributes
    ----------
    scale
        In units of sigma (of the output if no sigma is given). Without outliers, 1.345 sigma loses
        5 % of the precision of the sum of squares.
    """

    name: ClassVar[str] = "huber"

    def _rho(self, z: FloatArray) -> FloatArray:
        return np.asarray(np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0))

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / np.sqrt(np.maximum(z, 1.0))


@dataclass(frozen=True)
class SoftL1(_RobustCost):
    """A smooth transition from squares to absolute values: rho(z) = 2 (sqrt(1 + z) - 1).

    Attributes
    ----------
    scale
        In units of sigma (of the output if no sigma is given).
    """

    name: ClassVar[str] = "soft_l1"

    def _rho(self, z: FloatArray) -> FloatArray:
        # the same as 2 (sqrt(1 + z) - 1), without a loss of accuracy for small z
        finite = np.minimum(z, np.finfo(float).max)
        return np.where(z <= finite, 2.0 * finite / (np.sqrt(1.0 + finite) + 1.0), np.inf)

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / np.sqrt(1.0 + z)


@dataclass(frozen=True)
class CauchyCost(_RobustCost):
    """Large residuals have little influence: rho(z) = ln(1 + z).

    Use it for gross outliers. It may have several minima, so use a good start value or several
    starts.

    Attributes
    ----------
    scale
        In units of sigma (of the output if no sigma is given).
    """

    name: ClassVar[str] = "cauchy"

    def _rho(self, z: FloatArray) -> FloatArray:
        return np.asarray(np.log1p(z))

    def _rho_derivative(self, z: FloatArray) -> FloatArray:
        return 1.0 / (1.0 + z)


SMALLEST_SUM = 1e-300


@dataclass(frozen=True)
class GaussianLikelihood(Cost):
    """F = sum over outputs of n ln(S / n); S is the sum of squares of an output's n residuals.

    Up to a constant, this is -2 ln of the likelihood with the most likely standard deviations
    sqrt(S / n). So outputs with small residuals count more, with any unit. Use it for several
    outputs with unknown noise. With one output, the minimum is that of the sum of squares (G. A. F.
    Seber, C. J. Wild, Nonlinear Regression (1989), doi:10.1002/0471725315, section 2.2). The
    residuals of a cost function count as one output.
    """

    name: ClassVar[str] = "likelihood"
    is_logarithm: ClassVar[bool] = True

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        counts, sums = _sums(residuals, _output_numbers(residuals, outputs))
        return float(np.add.reduce(counts * np.log(sums / counts)))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        outputs = _output_numbers(residuals, outputs)
        counts, sums = _sums(residuals, outputs)
        present = np.unique(outputs)
        table = np.zeros(int(present.max(initial=-1)) + 1)
        table[present] = counts / sums
        return np.asarray(table[outputs])


def _output_numbers(residuals: FloatArray, outputs: IntArray) -> IntArray:
    """Return the output of each residual; one output if none are given."""
    return outputs if len(outputs) else np.zeros(len(residuals), np.int64)


def _sums(residuals: FloatArray, outputs: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the number and the sum of squares of the residuals of each output."""
    parts = [np.ascontiguousarray(residuals[outputs == each]) for each in np.unique(outputs)]
    counts = np.array([len(part) for part in parts], np.float64)
    with np.errstate(over="ignore"):
        sums = np.array([np.add.reduce(part * part) for part in parts], np.float64)
    return counts, np.maximum(sums, SMALLEST_SUM)


@dataclass(frozen=True)
class TotalCost(Cost):
    """F = sum of the numbers that the experiments' cost functions return.

    Use it for cost functions that return one number. For functions that return residuals, use `sse`
    or another cost of residuals.
    """

    name: ClassVar[str] = "total"

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        return float(np.add.reduce(np.ascontiguousarray(residuals)))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return None


COSTS: dict[str, type[Cost]] = {
    SumSquared.name: SumSquared,
    SumAbsolute.name: SumAbsolute,
    HuberCost.name: HuberCost,
    SoftL1.name: SoftL1,
    CauchyCost.name: CauchyCost,
    GaussianLikelihood.name: GaussianLikelihood,
    TotalCost.name: TotalCost,
}

COST_ALIASES = {"SSE": SumSquared.name, "residuals": SumSquared.name, "SAE": SumAbsolute.name}
"""Names that users of other tools know."""

__all__ = ["COSTS", "COST_ALIASES", "Cost"]
