"""How right the time left is that a run shows: predicted over what came, at shares of the run.

    python scripts/bench_progress.py [--seconds 60] [--spread 0.3] [--only NAME]

Searches run on virtual workers: the FMUs answer at once, and a virtual clock gives each simulation
a duration of its own, lognormal around a mean. So the figures do not depend on the machine. What
is shown after some shares of the time is compared with the time that was left then; "-" is where
nothing was said. Budgets that are used up tell the time, and so do searches that have ended of
many; nobody knows it of a single search that converges (`bench_convergence_rates.py`).
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from virtual_executor import VirtualExecutor

import cluster_est as ce
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config
from cluster_est.methods import METHODS
from cluster_est.methods.method import Method
from cluster_est.problem.search_space import make_space
from cluster_est.running.multistart import Multistart, search_from_starts
from cluster_est.running.resources import RunSnapshot
from cluster_est.running.runner import Runner
from workers.evaluate import Evaluator
from workers.messages import Task
from workers.wire import TaskBatch

CONFIGS = Path(__file__).parents[1] / "configs"
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


CASES = {
    "least_squares, 40 points": Case(METHODS["least_squares"](), budget=40),
    "least_squares, 40 points, 12 workers": Case(METHODS["least_squares"](), 1, 40, workers=12),
    "4 starts, 200 points": Case(METHODS["least_squares"](), 4, 200),
    "pattern_search, 150 points": Case(METHODS["pattern_search"](), budget=150),
    "nelder_mead, 100 points": Case(METHODS["nelder_mead"](bounds="enforce"), budget=100),  # type: ignore[call-arg]
    "de, 600 points": Case(METHODS["de"](), budget=600),
    "de, 600 points, 100 workers": Case(METHODS["de"](), budget=600, workers=100),
    "cmaes, 300 points": Case(METHODS["cmaes"](), budget=300),
    "cascaded tanks, least_squares, 40 points": Case(
        METHODS["least_squares"](), budget=40, config="cascaded_tanks"
    ),
    "de, 10 h": Case(METHODS["de"](), seconds=36000.0, workers=8),
    "least_squares, converges": Case(METHODS["least_squares"]()),
    "pattern_search, converges": Case(METHODS["pattern_search"]()),
    "16 starts, converge": Case(METHODS["least_squares"](), starts=16),
    "64 starts, converge": Case(METHODS["least_squares"](), starts=64),
    "64 starts, converge, 32 workers": Case(METHODS["least_squares"](), starts=64, workers=32),
    "cascaded tanks, 64 starts, converge": Case(
        METHODS["least_squares"](), starts=64, config="cascaded_tanks"
    ),
    "de, 20 generations": Case(METHODS["de"](max_generations=20)),  # type: ignore[call-arg]
}


@dataclass
class Recorded:
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


def run(case: Case, mean: float, spread: float) -> Recorded:
    """Run a case, and record what it shows."""
    problem = build_problem(read_config(CONFIGS / f"{case.config}.toml"), CONFIGS)
    evaluator = Evaluator(problem.model, problem.experiments, "virtual")

    def residuals(task: Task) -> NDArray[np.float64]:
        (outcome,) = evaluator.evaluate(TaskBatch.of([replace(task, bound=math.inf)]))
        return np.full(1, np.nan) if outcome.residuals is None else outcome.residuals

    def seconds(task: Task, generator: np.random.Generator) -> float:
        return float(mean * np.exp(spread * generator.normal()))

    executor = VirtualExecutor(residuals, seconds, case.workers)
    recorded = Recorded()

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


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="mean of a simulation")
    parser.add_argument("--spread", type=float, default=0.3, help="of its logarithm")
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    given = parser.parse_args()
    print(f"{'predicted over actual time left after':44s}" + "".join(f"{s:8.0%}" for s in SHARES))
    for name, case in CASES.items():
        if given.only in name:
            found = run(case, given.seconds, given.spread)
            texts = [_shown(found.ratio(share)) for share in SHARES]
            print(f"{name:44s}" + "".join(f"{text:>8s}" for text in texts), flush=True)


def _shown(ratio: float) -> str:
    return "-" if math.isnan(ratio) else f"{ratio:.2f}"


if __name__ == "__main__":
    main()
