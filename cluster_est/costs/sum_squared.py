"""Sum of squared residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray, Reduction


@dataclass(frozen=True)
class SumSquared(Cost):
    """F = sum of e(t)^2 over all outputs of all experiments.

    The default, and the maximum-likelihood estimate where the noise is normal and `sigma` is its
    standard deviation.
    """

    name: ClassVar[str] = "sse"
    reduction: ClassVar[Reduction | None] = "squares"

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        # not a dot product, whose rounding depends on the number of threads of the BLAS library
        with np.errstate(over="ignore"):  # an infinite cost is refused like any that is too high
            return float(np.add.reduce(residuals * residuals))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return np.ones_like(residuals)
