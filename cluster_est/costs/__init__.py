"""Costs: how the residuals of all experiments become one number. One file a cost.

A new cost is one file with a subclass of `Cost` and one line here.
"""

from __future__ import annotations

from cluster_est.costs.base import Cost
from cluster_est.costs.sum_squared import SumSquared

COSTS: dict[str, type[Cost]] = {SumSquared.name: SumSquared}

__all__ = ["COSTS", "Cost"]
