"""Pattern search on two Ray workers, and its asynchronous variant where simulations differ in time.

    python scripts/bench_pattern_search.py [--runs 5] [--iterations 10] [--step 2e-5]

First, a fit of eight parameters of the motor with a belt from the closed-loop benchmark, integrated
with a short fixed step, for a few iterations, with one and two workers by turns: the ratio of the
medians should be at most 0.6. What is timed begins with the first answer, when the workers stand.

Then, in virtual time, how long both variants take to a cost on 8 and 32 workers, where one
simulation in ten takes ten times longer, and where all take the same time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace

import numpy as np
from closed_loop_benchmark.data import make
from closed_loop_benchmark.problem import make_problem
from closed_loop_benchmark.scenarios import all_scenarios
from virtual_executor import VirtualExecutor

import cluster_est as ce
from cluster_est.methods.base import Method
from cluster_est.methods.pattern_search.asynchronous import AsynchronousPatternSearch
from cluster_est.methods.pattern_search.method import PatternSearch
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.resources import Resources, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Task

SYSTEM, PARAMETERS = "dc_motor_belt", 8
AWAY = 1.3
"""Times its starting value, where each parameter starts here."""
SLOW, SLOWER = 0.1, 10.0
TARGET = 1e-3


def main() -> None:
    """Print seconds and ratios of both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--step", type=float, default=2e-5)
    parser.add_argument("--seeds", type=int, default=11)
    parser.add_argument("--skip-ray", action="store_true")
    options = parser.parse_args()
    with one_blas_thread():
        if not options.skip_ray:
            compare_workers(make_motor(options.step), options.runs, options.iterations)
        compare_variants(options.seeds)


def make_motor(step: float) -> ce.Problem:
    """One experiment of a clean case of the benchmark, with as many free parameters as wanted."""
    name = next(c.name for c in all_scenarios() if c.name.startswith(f"{SYSTEM}/clean"))
    (case,) = [case for case in all_scenarios() if case.name == name]
    problem = make_problem(make(case))
    parameters = tuple(
        replace(p, start=min(AWAY * p.start, p.upper), fixed=i >= PARAMETERS)
        for i, p in enumerate(problem.parameters)
    )
    model = replace(problem.model, solver=ce.Solver("rk4", step=step))
    return replace(problem, model=model, parameters=parameters, experiments=problem.experiments[:1])


def compare_workers(problem: ce.Problem, runs: int, iterations: int) -> None:
    """Print how long a search takes with one and with two workers."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(runs):
        for workers in seconds:
            spent, cost, simulated, each = timed(problem, workers, iterations)
            seconds[workers].append(spent)
            print(
                f"{workers} worker(s): {spent:.2f} s, cost {cost:.6g}, "
                f"{simulated} simulations of {1e3 * each:.0f} ms",
                flush=True,
            )
    one, two = (statistics.median(seconds[n]) for n in (1, 2))
    print(f"two workers / one: {two / one:.2f} (medians {two:.2f} s and {one:.2f} s)")


def timed(problem: ce.Problem, workers: int, iterations: int) -> tuple[float, float, int, float]:
    """Seconds from the first answer, cost, simulations, median seconds of one."""
    first: list[float] = []
    each: list[float] = []

    def record(origin: object, outcome: Outcome) -> None:
        if not first:
            first.append(time.perf_counter())
        each.append(outcome.seconds)

    method = PatternSearch(max_iterations=iterations)
    space = make_space(problem, (0,))
    with open_executor(problem, Resources("ray", workers)) as executor:
        runner = Runner(executor, record=record)
        (solution,) = runner.run([SearchRequest("bench", method, space)])
        spent = time.perf_counter() - first[0]
    return spent, solution.cost, len(each), statistics.median(each)


def compare_variants(seeds: int) -> None:
    """Print the virtual time that both variants take to the target."""
    variants: tuple[Method, Method] = PatternSearch(), AsynchronousPatternSearch()
    for share in (SLOW, 0.0):
        for workers in (8, 32):
            times = np.array(
                [[time_to_target(m, s, workers, share) for m in variants] for s in range(seeds)]
            )
            plain, free = np.median(times, axis=0)
            ratios = times[:, 1] / times[:, 0]
            print(
                f"{workers} workers, {share:.0%} of simulations {SLOWER:.0f} times longer: "
                f"asynchronous / synchronous {free / plain:.2f} "
                f"(medians {free:.0f} and {plain:.0f}; ratios {ratios.min():.2f} to "
                f"{ratios.max():.2f})"
            )


class ReachedError(Exception):
    """The target is reached: the clock of the executor says when."""


def time_to_target(method: Method, seed: int, workers: int, share: float) -> float:
    """Virtual seconds until a simulation ends whose cost is below the target."""

    def residuals(task: Task) -> np.ndarray:
        found = valley(task.values)
        if np.add.reduce(found**2) < TARGET:
            raise ReachedError
        return found

    def seconds(task: Task, generator: np.random.Generator) -> float:
        return SLOWER if generator.random() < share else 1.0

    executor = VirtualExecutor(residuals, seconds, workers, seed=seed)
    space = make_space(valley_problem(), (0,))
    try:
        Runner(executor).run([SearchRequest("bench", method, space, seed)])
    except ReachedError:
        return executor.now
    return np.inf


def valley(x: np.ndarray) -> np.ndarray:
    """Residuals of a curved valley through all unknowns; 0 where each is 1."""
    return np.concatenate([3.0 * (x[1:] - x[:-1] ** 2), 1.0 - x])


def valley_problem() -> ce.Problem:
    """Eight unknowns whose model is never simulated."""
    names = tuple(f"x{i}" for i in range(PARAMETERS))
    times = np.arange(1.0, 2.0 * PARAMETERS)
    experiment = ce.Experiment(
        "e", 0.0, 2.0 * PARAMETERS, (), (ce.Output("y", times, 0.0 * times),)
    )
    model = ce.Model("none", b"", "model_exchange", ce.Solver("rk4"), names)
    return ce.Problem(model, tuple(ce.Parameter(name, 0.5) for name in names), (experiment,))


if __name__ == "__main__":
    main()
