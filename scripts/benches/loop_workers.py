"""How much two Ray workers shorten a closed loop: the ratio of interleaved runs on one machine.

The loop is that of a `config`, or of a `case` of the closed-loop benchmark, here integrated with so
short a `step` that a simulation costs what one of a larger model does: workers share the
simulations, not the linear algebra of the screening, so the ratio depends on what a simulation
costs. Each run starts its workers anew; what is timed begins with the first answer and ends with
the result, as in a long session on a cluster.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from closed_loop_benchmark.data import make, make_problem
from closed_loop_benchmark.scenarios import all_scenarios

import cluster_est as ce
from benches import Row
from cluster_est.closed_loop.loop import close_loop
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config

OPTIONS = {
    "case": "mass_spring_damper/single/coulomb x0.25", "step": 1e-4, "config": "", "runs": 3
}  # fmt: skip


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each run with one worker and with two, and one with the ratio of the medians."""
    settings = ce.LoopSettings()
    if options.config:
        path = Path(options.config)
        config = read_config(path)
        problem, settings = build_problem(config, path.parent), config.closed_loop
    else:
        problem = of_case(options.case, options.step)
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(options.runs):
        for workers in seconds:
            spent, simulated = timed(problem, workers, settings)
            seconds[workers].append(spent)
            yield {"workers": workers, "seconds": spent, "simulations": simulated}
    one, two = (statistics.median(seconds[n]) for n in (1, 2))
    yield {"two workers over one": two / one, "two: seconds": two, "one: seconds": one}


def of_case(name: str, step: float) -> ce.Problem:
    """A case of the benchmark, integrated with a fixed step."""
    (case,) = [case for case in all_scenarios() if case.name == name]
    problem = make_problem(make(case))
    model = replace(problem.model, solver=ce.Solver("rk4", step=step))
    return replace(problem, model=model)


def timed(problem: ce.Problem, workers: int, settings: ce.LoopSettings) -> tuple[float, int]:
    """Seconds from the first simulation to the result, and the number of simulations."""
    first: list[float] = []

    def note(origin: object, outcome: object) -> None:
        if not first:
            first.append(time.perf_counter())

    result = close_loop(problem, ce.Resources("ray", workers), settings, record=note)
    return time.perf_counter() - first[0], result.simulated
