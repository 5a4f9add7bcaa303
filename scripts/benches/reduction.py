"""What it saves to send one number for each output in the place of its residuals.

The test FMU `chain`, whose five outputs make 10,000 residuals of 2,000 `times`, is fitted by `de`
with a cost that lets workers reduce residuals and with the same cost without that, by turns, with
so many `workers` of an `executor`. A row has the median seconds of the searches, and their ratio.
The costs must be the same.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import ClassVar

import cluster_est as ce
from benches import Row
from benches.common import searches_by_turns
from benches.sensitivities import chain_problem
from cluster_est.methods import SEARCH_METHODS
from cluster_est.problem.costs import SumSquared
from workers.messages import Reduction

OPTIONS = {
    "rounds": 5, "times": 2000, "experiments": 1, "workers": 2, "executor": "ray",
    "evaluations": 1000,
}  # fmt: skip


class WholeSumSquared(SumSquared):
    """The sum of squares, for which workers send every residual."""

    reduction: ClassVar[Reduction | None] = None


COSTS = {"reduced": SumSquared(), "whole": WholeSumSquared()}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each way."""
    problem = chain_problem(options.times, options.experiments)
    budget = ce.Budget(evaluations=options.evaluations)
    resources = ce.Resources(options.executor, options.workers, budget=budget)
    ways = {
        way: partial(ce.fit, replace(problem, cost=cost), SEARCH_METHODS["de"](), resources)
        for way, cost in COSTS.items()
    }
    found = searches_by_turns(ways, options.rounds)
    for way, (seconds, result) in found.items():
        yield {"sent": way, "seconds": seconds, "of reduced": seconds / found["reduced"][0],
               "cost": result.solution.cost}  # fmt: skip
