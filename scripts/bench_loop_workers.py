"""How much two Ray workers shorten a closed loop: the ratio of interleaved runs on one machine.

    python scripts/bench_loop_workers.py CONFIG [--runs 3] [key=value ...]

Each run starts its workers anew; what is timed begins when they stand ready and ends with the
result, as in a long session on a cluster.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import cluster_est as ce
from cluster_est.build import build_problem, build_settings
from cluster_est.closed_loop.loop import close_loop
from cluster_est.closed_loop.result import LoopResult
from cluster_est.config import read_config


def main() -> None:
    """Run the loop with one and two workers by turns and print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    config = read_config(options.config, options.overrides)
    problem = build_problem(config, options.config.parent)
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(options.runs):
        for workers in seconds:
            spent, result = timed(problem, workers, build_settings(config))
            seconds[workers].append(spent)
            print(f"{workers} worker(s): {spent:.1f} s, {result.simulated} simulations", flush=True)
    one, two = (statistics.median(seconds[n]) for n in (1, 2))
    print(f"two workers / one: {two / one:.2f} (medians {two:.1f} s and {one:.1f} s)")


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
