"""Sum of absolute residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray, Reduction


@dataclass(frozen=True)
class SumAbsolute(Cost):
    """F = sum of |e(t)| over all outputs of all experiments.

    For data with outliers, where a few large residuals must not decide. It has a kink wherever a
    residual is 0, so that a method should not need its gradient: `pattern_search` and
    `nelder_mead` do not. `huber` with a small `scale` is nearly the same and smooth.
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
