"""How many of n random starts within the bounds reach the same minimum.

    python scripts/random_starts.py configs/cascaded_tanks.toml --starts 20

All starts share one queue. A start is uniform between the bounds, or between their logarithms where
the parameter's scale is "log"; every parameter needs finite bounds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_est.config.build import build_problem
from cluster_est.config.options import build_method, build_resources
from cluster_est.config.reader import read_config
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    config = read_config(options.config)
    problem = build_problem(config, options.config.parent)
    method, resources = build_method(config), build_resources(config)
    generator = np.random.default_rng(options.seed)
    spaces = [random_start(problem, generator) for _ in range(options.starts)]
    with open_executor(problem, resources) as executor:
        runner = Runner(executor)
        requests = [SearchRequest(f"start {i}", method, s) for i, s in enumerate(spaces)]
        solutions = runner.run(requests)
    costs = np.array([solution.cost for solution in solutions])
    best = np.nanmin(costs)
    for solution in sorted(solutions, key=lambda s: s.cost):
        print(f"cost {solution.cost:14.8g}  {solution.iterations:3d} iterations  {solution.ending}")
    same = int(np.sum(costs <= best * (1.0 + 1e-6)))
    print(f"{same} of {len(costs)} starts reach the best minimum, cost {best:.8g}, to 1e-6")


def random_start(problem: Problem, generator: np.random.Generator) -> SearchSpace:
    """The training space of the problem from a random point within its bounds."""
    parameters = []
    for parameter in problem.parameters:
        low, high = parameter.lower, parameter.upper
        if parameter.scale == "log":
            start = float(np.exp(generator.uniform(np.log(low), np.log(high))))
        else:
            start = float(generator.uniform(low, high))
        parameters.append(replace(parameter, start=start))
    return make_space(replace(problem, parameters=tuple(parameters)), problem.indices("train"))


if __name__ == "__main__":
    main()
