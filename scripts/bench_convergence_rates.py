"""Whether the rate at which a search converges tells how long it still takes. It does not.

    python scripts/bench_convergence_rates.py [--starts 5] [--most 6000]

Each method searches the embedded examples from several starts. After shares of its points, the rate
so far is extended to the tolerance of the method: of the logarithm of the mesh, simplex or
population over the second half of the points so far, or, for `least_squares` and `sqp`, of the
logarithm of the relative fall of the cost over the last iterations. Printed is how often the number
of points that this predicts is wrong by more than a factor of 1.5.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cluster_est as ce
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config
from cluster_est.methods import METHODS
from cluster_est.methods.method import Ending
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.multistart import Multistart, sample
from cluster_est.running.resources import SearchIteration
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

Array = NDArray[np.float64]
CONFIGS = Path(__file__).parents[1] / "configs"
EXAMPLES = ("mass_spring_damper", "mass_with_friction", "cascaded_tanks")
BY_COST = ("least_squares", "sqp")
BY_SIZE = {"nelder_mead": "damping", "pattern_search": "damping", "cmaes": "step", "de": "step"}
"""The field of `Progress` that shrinks to the tolerance."""
SIZE_TOLERANCE, COST_TOLERANCE = 1e-6, 1e-10
SHARES, WRONG = (0.1, 0.25, 0.5, 0.75), 1.5


def bounded(problem: Problem) -> Problem:
    """Return a problem whose parameters have finite bounds, as samples and populations need."""
    chosen = []
    for p in problem.parameters:
        upper = p.upper if np.isfinite(p.upper) else 5.0 * max(abs(p.start), 1.0)
        chosen.append(replace(p, lower=p.lower if np.isfinite(p.lower) else 0.0, upper=upper))
    return replace(problem, parameters=tuple(chosen))


def converged(problem: Problem, name: str, start: int, most: int) -> list[SearchIteration]:
    """Return the iterations of a search from a start; none if it does not converge."""
    space = make_space(problem, problem.indices("train"))
    starts = [space.start, *sample(space, 4, Multistart(seed=1))]
    options = {"bounds": "enforce"} if name == "nelder_mead" else {}
    lines: list[SearchIteration] = []
    with open_executor(problem, ce.Resources(workers=1)) as executor:
        runner = Runner(executor, ce.Budget(evaluations=most), note=lines.append)
        request = SearchRequest("train", METHODS[name](**options), space.starting_at(starts[start]))
        (solution,) = runner.run([request])
    return lines if solution.ending is Ending.CONVERGED else []


def by_size(lines: list[SearchIteration], name: str) -> float:
    """Return the points left by the size of a mesh, simplex or population; NaN if it is growing."""
    sizes = np.log([getattr(each.progress, BY_SIZE[name]) for each in lines])
    points = np.array([each.evaluations for each in lines], np.float64)[np.isfinite(sizes)]
    sizes = sizes[np.isfinite(sizes)]
    half = len(sizes) // 2
    if len(sizes) < 4 or not sizes[-1] < sizes[half]:
        return np.nan
    rate = (sizes[half] - sizes[-1]) / (points[-1] - points[half])
    return float((sizes[-1] - np.log(SIZE_TOLERANCE)) / rate)


def by_cost(lines: list[SearchIteration]) -> float:
    """Return the points left by how ever less the cost falls; NaN if it falls ever more."""
    last = {each.progress.iteration: each for each in lines}
    known = [each for each in last.values() if np.isfinite(each.progress.cost)]
    costs = np.array([each.progress.cost for each in known])
    falls = np.maximum((costs[:-1] - costs[1:]) / costs[1:], 1e-16)
    if len(falls) < 3 or not falls[-1] < falls[-3]:
        return np.nan
    iterations = np.log(COST_TOLERANCE / falls[-1]) / (0.5 * np.log(falls[-1] / falls[-3]))
    of_each = (known[-1].evaluations - known[0].evaluations) / (len(known) - 1)
    return float(max(iterations, 0.0) * of_each)


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=5, choices=range(1, 6))
    parser.add_argument("--most", type=int, default=6000, help="points of a search")
    given = parser.parse_args()
    wrong, searches = dict.fromkeys(SHARES, 0), 0
    for example in EXAMPLES:
        problem = bounded(build_problem(read_config(CONFIGS / f"{example}.toml"), CONFIGS))
        for name in (*BY_COST, *BY_SIZE):
            for start in range(1 if name in ("cmaes", "de") else given.starts):
                lines = converged(problem, name, start, given.most)
                searches += bool(lines)
                for share in SHARES if lines else ():
                    end = lines[-1].evaluations
                    known = [each for each in lines if each.evaluations <= share * end]
                    if known:
                        left = by_cost(known) if name in BY_COST else by_size(known, name)
                        ratio = left / (end - known[-1].evaluations)
                    wrong[share] += not (known and 1.0 / WRONG < ratio < WRONG)
    for share, count in wrong.items():
        print(f"after {share:4.0%} of the points: wrong in {count} of {searches} searches")


if __name__ == "__main__":
    main()
