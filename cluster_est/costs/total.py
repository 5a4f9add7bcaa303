"""The sum of what a cost function of the user's returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class TotalCost(Cost):
    """F = sum of the numbers that the experiments' cost functions return.

    For a cost function that returns one number. One that returns residuals wants `sse` or another
    cost of residuals.
    """

    name: ClassVar[str] = "total"

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        return float(np.add.reduce(np.ascontiguousarray(residuals)))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return None
