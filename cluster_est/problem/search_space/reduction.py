"""Reduction of residuals to one number for each output before a worker sends them."""

from __future__ import annotations

from cluster_est.costs.base import Cost
from workers.messages import Experiment, Want

LEAST_RESIDUALS = 10
"""Up to so many residuals for each output of an experiment, on average, nothing is saved: an answer
takes about as many bytes besides, and whole residuals may spare another search a simulation."""


def want_of(experiment: Experiment, cost: Cost | None) -> Want:
    """Return what is asked for where nothing but this cost is looked at.

    A cost of None stands for a look at single residuals too.

    It follows from the problem alone, never from what workers do, so that results cannot depend on
    these. What a cost function of the user's returns is never reduced: it says nothing of outputs.
    """
    if cost is None or cost.reduction is None or experiment.cost_function is not None:
        return "residuals"
    filled = sum(count > 0 for count in experiment.counts)
    return cost.reduction if experiment.size > LEAST_RESIDUALS * filled else "residuals"
