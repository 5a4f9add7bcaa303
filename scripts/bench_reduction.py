"""What it saves to send one number for each output in the place of its residuals.

    python scripts/bench_reduction.py [--rounds 5] [--times 2000] [--workers 2] [--executor ray]

The test FMU `chain`, whose five outputs make 10,000 residuals of 2,000 times, is fitted by `de`
with a cost that lets workers reduce residuals and with the same cost without that, by turns.
Printed are the median seconds of the searches, and their ratio. The costs must be the same.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from bench_sensitivities import make_problem
from fmus.build import build

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.fit import fit
from cluster_est.methods.populations.pymoo_methods import DifferentialEvolution
from cluster_est.running.resources import Budget, Resources
from workers.messages import Reduction


class WholeSumSquared(SumSquared):
    """The sum of squares, for which workers send every residual."""

    reduction: ClassVar[Reduction | None] = None


COSTS = {"reduced": SumSquared(), "whole": WholeSumSquared()}


def main() -> None:
    """Fit by turns and print a line for each way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--times", type=int, default=2000)
    parser.add_argument("--experiments", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--executor", default="ray")
    parser.add_argument("--evaluations", type=int, default=1000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        archive = build("chain", 2, Path(folder)).read_bytes()
    problem = make_problem(archive, options.times, options.experiments)
    budget = Budget(evaluations=options.evaluations)
    resources = Resources(executor=options.executor, workers=options.workers, budget=budget)
    seconds: dict[str, list[float]] = {way: [] for way in COSTS}
    best: dict[str, float] = {}
    for turn in range(options.rounds + 1):
        for way, cost in COSTS.items():
            result = fit(replace(problem, cost=cost), DifferentialEvolution(), resources)
            best[way] = result.solution.cost
            if turn > 0:  # the first compiles
                seconds[way].append(result.search_seconds)
    for way, each in seconds.items():
        ratio = statistics.median(each) / statistics.median(seconds["reduced"])
        print(
            f"{way}: {statistics.median(each):.3f} s, {ratio:.2f} of reduced, cost {best[way]:.9g}"
        )


if __name__ == "__main__":
    main()
