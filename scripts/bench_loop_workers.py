"""How much two Ray workers shorten a closed loop: the ratio of interleaved runs on one machine.

    python scripts/bench_loop_workers.py CONFIG [key=value ...]
    python scripts/bench_loop_workers.py --case "mass_spring_damper/single/coulomb x0.25"

A case is one of the closed-loop benchmark, here integrated with so short a step that a simulation
costs what one of a larger model does: workers share the simulations, not the linear algebra of the
screening, so the ratio depends on what a simulation costs. Each run starts its workers anew; what
is timed begins with the first answer and ends with the result, as in a long session on a cluster.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path

from closed_loop_benchmark.data import make, make_problem
from closed_loop_benchmark.scenarios import all_scenarios

import cluster_est as ce
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.loop import close_loop
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config


def main() -> None:
    """Run the loop with one and two workers by turns and print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path, nargs="?")
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--case")
    parser.add_argument("--step", type=float, default=1e-4)
    options = parser.parse_args()
    if options.case:
        problem, settings = of_case(options.case, options.step), ce.LoopSettings()
    else:
        config = read_config(options.config, options.overrides)
        problem = build_problem(config, options.config.parent)
        settings = config.closed_loop
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(options.runs):
        for workers in seconds:
            spent, result = timed(problem, workers, settings)
            seconds[workers].append(spent)
            print(f"{workers} worker(s): {spent:.1f} s, {result.simulated} simulations", flush=True)
    one, two = (statistics.median(seconds[n]) for n in (1, 2))
    print(f"two workers / one: {two / one:.2f} (medians {two:.1f} s and {one:.1f} s)")


def of_case(name: str, step: float) -> ce.Problem:
    """A case of the benchmark, integrated with a fixed step."""
    (case,) = [case for case in all_scenarios() if case.name == name]
    problem = make_problem(make(case))
    model = replace(problem.model, solver=ce.Solver("rk4", step=step))
    return replace(problem, model=model)


def timed(problem: ce.Problem, workers: int, settings: ce.LoopSettings) -> tuple[float, LoopResult]:
    """Seconds from the first simulation to the result, and the result."""
    first: list[float] = []

    def note(origin: object, outcome: object) -> None:
        if not first:
            first.append(time.perf_counter())

    result = close_loop(problem, ce.Resources("ray", workers), settings, record=note)
    return time.perf_counter() - first[0], result


if __name__ == "__main__":
    main()
