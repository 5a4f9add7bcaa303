"""How right the time left is that a run shows: predicted over what came, at shares of the run.

Searches run on virtual workers: the FMUs answer at once, and a virtual clock gives each simulation
a duration of its own, lognormal around a mean of `seconds` with a standard deviation of the
logarithm of `spread`. So the figures do not depend on the machine. What is shown after some shares
of the time is compared with the time that was left then; NaN is where nothing was said. Budgets
that are used up tell the time, and so do searches that have ended of many; nobody knows it of a
single search that converges (the bench `convergence_rates`). `only` names a part of a case's name.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from virtual_executor import VirtualExecutor

import cluster_est as ce
from benches import Row
from benches.common import Array, example
from cluster_est.methods import SEARCH_METHODS
from cluster_est.methods.method import Method
from cluster_est.problem.search_space import make_space
from cluster_est.running.multistart import Multistart, search_from_starts
from cluster_est.running.resources import RunSnapshot
from cluster_est.running.runner import Runner
from workers.evaluate import Evaluator
from workers.messages import Task
from workers.wire import TaskBatch

OPTIONS = {"seconds": 60.0, "spread": 0.3, "only": ""}
SHARES = (0.1, 0.25, 0.5)


@dataclass(frozen=True)
class Case:
    """A search on virtual workers."""

    method: Method
    starts: int = 1
    budget: int | None = None
    seconds: float | None = None
    workers: int = 4
    config: str = "mass_with_friction"


LEAST_SQUARES = SEARCH_METHODS["least_squares"]()
CASES = {
    "least_squares, 40 points": Case(LEAST_SQUARES, budget=40),
    "least_squares, 40 points, 12 workers": Case(LEAST_SQUARES, 1, 40, workers=12),
    "4 starts, 200 points": Case(LEAST_SQUARES, 4, 200),
    "pattern_search, 150 points": Case(SEARCH_METHODS["pattern_search"](), budget=150),
    "nelder_mead, 100 points": Case(SEARCH_METHODS["nelder_mead"](bounds="enforce"), budget=100),  # type: ignore[call-arg]
    "de, 600 points": Case(SEARCH_METHODS["de"](), budget=600),
    "de, 600 points, 100 workers": Case(SEARCH_METHODS["de"](), budget=600, workers=100),
    "cmaes, 300 points": Case(SEARCH_METHODS["cmaes"](), budget=300),
    "tanks, least_squares, 40 points": Case(LEAST_SQUARES, budget=40, config="cascaded_tanks"),
    "de, 10 h": Case(SEARCH_METHODS["de"](), seconds=36000.0, workers=8),
    "least_squares, converges": Case(LEAST_SQUARES),
    "pattern_search, converges": Case(SEARCH_METHODS["pattern_search"]()),
    "16 starts, converge": Case(LEAST_SQUARES, starts=16),
    "64 starts, converge": Case(LEAST_SQUARES, starts=64),
    "64 starts, converge, 32 workers": Case(LEAST_SQUARES, starts=64, workers=32),
    "tanks, 64 starts, converge": Case(LEAST_SQUARES, starts=64, config="cascaded_tanks"),
    "de, 20 generations": Case(SEARCH_METHODS["de"](max_generations=20)),  # type: ignore[call-arg]
}


@dataclass
class RecordedDisplay:
    """What a display was shown, and when."""

    times: list[float] = field(default_factory=list)
    left: list[float] = field(default_factory=list)
    paces: list[tuple[float, int, float]] = field(default_factory=list)
    """Time, iteration and what is said of the time of one."""

    def ratio(self, share: float) -> float:
        """Return predicted over actual time left after a share of the time."""
        end = self.times[-1]
        place = int(np.searchsorted(self.times, share * end))
        return self.left[place] / (end - self.times[place])


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each case, with a column for each share of the time."""
    for name, case in CASES.items():
        if options.only in name:
            found = run(case, options.seconds, options.spread)
            ratios: Row = {f"after {share:.0%}": found.ratio(share) for share in SHARES}
            yield {"predicted over actual time left": name, **ratios}


def run(case: Case, mean: float, spread: float) -> RecordedDisplay:
    """Run a case, and record what it shows."""
    problem = example(case.config)
    evaluator = Evaluator(problem.model, problem.experiments, "virtual")

    def residuals(task: Task) -> Array:
        (outcome,) = evaluator.evaluate(TaskBatch.of([replace(task, bound=math.inf)]))
        return np.full(1, np.nan) if outcome.residuals is None else outcome.residuals

    def seconds(task: Task, generator: np.random.Generator) -> float:
        return float(mean * np.exp(spread * generator.normal()))

    executor = VirtualExecutor(residuals, seconds, case.workers)
    recorded = RecordedDisplay()

    def show(snapshot: RunSnapshot) -> None:
        recorded.times.append(executor.now)
        recorded.left.append(snapshot.left)
        recorded.paces.append((executor.now, snapshot.progress.iteration, snapshot.pace))

    budget = ce.Budget(evaluations=case.budget, seconds=case.seconds)
    runner = Runner(executor, budget, show=show, clock=lambda: executor.now)
    space = make_space(problem, problem.indices("train"))
    search_from_starts(runner, space, case.method, Multistart(n=case.starts), 0)
    evaluator.close()
    return recorded
