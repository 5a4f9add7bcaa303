"""Costs: functions from the residuals of all experiments to one number. One file a family.

A new cost is one file with a subclass of `Cost` and one line here.
"""

from __future__ import annotations

from cluster_est.costs.base import Cost
from cluster_est.costs.likelihood import GaussianLikelihood
from cluster_est.costs.robust import CauchyCost, HuberCost, SoftL1
from cluster_est.costs.sum_absolute import SumAbsolute
from cluster_est.costs.sum_squared import SumSquared
from cluster_est.costs.total import TotalCost

COSTS: dict[str, type[Cost]] = {
    SumSquared.name: SumSquared,
    SumAbsolute.name: SumAbsolute,
    HuberCost.name: HuberCost,
    SoftL1.name: SoftL1,
    CauchyCost.name: CauchyCost,
    GaussianLikelihood.name: GaussianLikelihood,
    TotalCost.name: TotalCost,
}

ALIASES = {"SSE": SumSquared.name, "residuals": SumSquared.name, "SAE": SumAbsolute.name}
"""Names that users of other tools know; raw residuals are what every cost of them gets anyway."""

__all__ = ["ALIASES", "COSTS", "Cost"]
