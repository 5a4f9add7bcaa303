"""Sum of squared residuals."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cluster_est.costs.base import Cost
from workers.messages import FloatArray


class SumSquared(Cost):
    """F = sum of e(t)^2 over all outputs of all experiments.

    The default, and the maximum-likelihood estimate where the noise is normal and `sigma` is its
    standard deviation.
    """

    name: ClassVar[str] = "sse"
    sum_of_squares: ClassVar[bool] = True

    def terms(self, residuals: FloatArray) -> FloatArray:
        return residuals

    def value(self, residuals: FloatArray) -> float:
        # not a dot product, whose rounding depends on the number of threads of the BLAS library
        with np.errstate(over="ignore"):  # an infinite cost is refused like any that is too high
            return float(np.add.reduce(residuals * residuals))
