"""Whether the rate at which a search converges tells how long it still takes. It does not.

Each method searches the embedded examples from several starts (`starts`, five at most, with `most`
points each). After shares of its points, the rate so far is extended to the tolerance of the
method: of the logarithm of the mesh, simplex or population over the second half of the points so
far, or, for `least_squares` and `sqp`, of the logarithm of the relative fall of the cost over the
last iterations. Counted is how often the number of points that this predicts is wrong by more than
a factor of 1.5.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import cluster_est as ce
from benches import Row
from benches.common import EXAMPLES, example
from cluster_est.methods import SEARCH_METHODS
from cluster_est.methods.method import Ending
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.multistart import Multistart, sample
from cluster_est.running.resources import SearchIteration
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

OPTIONS = {"starts": 5, "most": 6000}
BY_COST = ("least_squares", "sqp")
BY_SIZE = {"nelder_mead": "damping", "pattern_search": "damping", "cmaes": "step", "de": "step"}
"""The field of `Progress` that shrinks to the tolerance."""
SIZE_TOLERANCE, COST_TOLERANCE = 1e-6, 1e-10
SHARES, WRONG = (0.1, 0.25, 0.5, 0.75), 1.5


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each share of the points."""
    wrong, searches = dict.fromkeys(SHARES, 0), 0
    for name_of_example in EXAMPLES:
        problem = bounded(example(name_of_example))
        for name in (*BY_COST, *BY_SIZE):
            for start in range(1 if name in ("cmaes", "de") else options.starts):
                lines = converged(problem, name, start, options.most)
                searches += bool(lines)
                for share in SHARES if lines else ():
                    end = lines[-1].evaluations
                    known = [each for each in lines if each.evaluations <= share * end]
                    if known:
                        left = by_cost(known) if name in BY_COST else by_size(known, name)
                        ratio = left / (end - known[-1].evaluations)
                    wrong[share] += not (known and 1.0 / WRONG < ratio < WRONG)
    for share, count in wrong.items():
        yield {"after this share of the points": share, "wrong": count, "of searches": searches}


def bounded(problem: ce.Problem) -> ce.Problem:
    """Return a problem whose parameters have finite bounds, as samples and populations need."""
    chosen = []
    for p in problem.parameters:
        upper = p.upper if np.isfinite(p.upper) else 5.0 * max(abs(p.start), 1.0)
        lower = p.lower if np.isfinite(p.lower) else 0.0
        chosen.append(replace(p, bounds=(lower, upper)))
    return replace(problem, parameters=tuple(chosen))


def converged(problem: ce.Problem, name: str, start: int, most: int) -> list[SearchIteration]:
    """Return the iterations of a search from a start; none if it does not converge."""
    space = make_space(problem, problem.indices("train"))
    starts = [space.start, *sample(space, 4, Multistart(seed=1))]
    options = {"bounds": "enforce"} if name == "nelder_mead" else {}
    lines: list[SearchIteration] = []
    with open_executor(problem, ce.Resources(workers=1)) as executor:
        runner = Runner(executor, ce.Budget(evaluations=most), note=lines.append)
        request = SearchRequest(
            "train", SEARCH_METHODS[name](**options), space.starting_at(starts[start])
        )
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
