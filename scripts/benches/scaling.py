"""How far one coordinator goes: its memory, its seconds for an iteration, and its cost of a task.

With `experiments`, shared and local unknowns of so many experiments are fitted with
`least_squares`, and rows have what each iteration costs the coordinator. Nothing is simulated: a
formula takes the place of simulations, and the time that it takes is left out.

With `virtual`, the real runner is driven with workers that are as many as you like and have virtual
clocks. What the coordinator really works, in seconds of this machine's processor, passes on those
clocks too, so workers stand idle where it cannot keep up. `overhead` adds what sending a task costs
on a cluster, in microseconds, which is not in there.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from virtual_executor import VirtualExecutor

from benches import Row
from cluster_est import Experiment, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.methods.method import Ending, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.run_folder.evaluation_log import EvaluationLog
from cluster_est.running.resources import SearchIteration, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import assess
from workers.messages import FloatArray, Task

OPTIONS = {"experiments": 0, "virtual": [0], "overhead": 0.0}
TIMES = np.linspace(0.1, 3.0, 20)
SHARED = 10
HARMONICS = np.arange(2.0, SHARED + 1.0)
SECONDS = (0.1, 1.0, 10.0)
TASKS_OF_A_WORKER = 30
EXPERIMENTS = 100


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Rows of iterations, and a row for each number of workers and time of a simulation."""
    with one_blas_thread():
        if options.experiments:
            yield from fit_many(options.experiments)
        for workers in filter(None, options.virtual):
            for seconds in SECONDS:
                share, cost = busy(workers, seconds, 1e-6 * options.overhead)
                yield {"workers": workers, "simulation s": seconds, "busy": share,
                       "coordinator us a task": 1e6 * cost}  # fmt: skip


def formula(experiment: int, values: FloatArray) -> FloatArray:
    """gain (sin(w t + f) + sum of a_k sin(k t + k f)) + offset, with a phase f of its own."""
    phase = 0.1 * experiment
    shape = np.sin(values[0] * TIMES + phase)
    shape += values[1:SHARED] @ np.sin(HARMONICS[:, None] * (TIMES + phase))
    return np.asarray(values[SHARED] * shape + values[SHARED + 1])


def problem_of(parameters: list[Parameter], measured: list[FloatArray]) -> Problem:
    """A problem whose model is never simulated, with one output for each experiment."""
    runs = tuple(
        Experiment(f"e{e}", 0.0, 3.0, (), (Output("y", TIMES, values),))
        for e, values in enumerate(measured)
    )
    names = tuple(p.name for p in parameters)
    model = Model("none", b"", "model_exchange", Solver("rk4"), names)
    return Problem(model, tuple(parameters), runs)


def many_experiments(count: int) -> tuple[Problem, Callable[[Task], FloatArray]]:
    """A problem with 10 shared and 2 x `count` local unknowns, and what answers its tasks."""
    generator = np.random.default_rng(0)
    shared = np.append(0.5, 0.3 * generator.normal(size=SHARED - 1))
    gains, offsets = generator.uniform(0.5, 1.5, count), generator.normal(size=count)
    measured = [
        formula(e, np.array([*shared, gains[e], offsets[e]])) + 0.05 * generator.normal(size=20)
        for e in range(count)
    ]
    parameters = [Parameter("w", 0.6, (0.1, 2.0))]
    parameters += [Parameter(f"a{k}", 0.1, (-5.0, 5.0)) for k in range(1, SHARED)]
    parameters += [Parameter("gain", 1.0, (0.6, 1.4), per="experiment")]  # one in five at a bound
    parameters += [Parameter("offset", 0.1, (-10.0, 10.0), per="experiment")]

    def residuals(task: Task) -> FloatArray:
        return measured[task.experiment] - formula(task.experiment, task.values)

    return problem_of(parameters, measured), residuals


def memory() -> float:
    """The most that this process has had in memory, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def fit_many(count: int) -> Iterator[Row]:
    """Fit many experiments: what it costs the coordinator."""
    problem, residuals = many_experiments(count)
    yield {"experiments": count, "data GB": memory()}
    space = make_space(problem, tuple(range(count)))
    executor = VirtualExecutor(residuals, lambda task, generator: 1.0, 64, clock=time.process_time)
    iterations: list[Row] = []
    spent = [(0.0, 0)]

    def note(line: SearchIteration) -> None:
        (seconds, points), now = spent[-1], (executor.coordinator, line.evaluations)
        spent.append(now)
        progress = line.progress
        iterations.append({
            "iteration": progress.iteration, "cost": progress.cost, "GB": memory(),
            "coordinator s": now[0] - seconds, "tasks": (now[1] - points) * count,
        })  # fmt: skip

    runner = Runner(executor, note=note)
    (solution,) = runner.run([SearchRequest("fit", LeastSquares(), space)])
    yield from iterations
    held = np.count_nonzero((solution.x <= space.lower) | (solution.x >= space.upper))
    each = 1e6 * executor.coordinator / runner.simulations
    begin = time.process_time()
    assess(space, solution)
    took = time.process_time() - begin
    yield {"ending": str(solution.ending), "unknowns": space.size, "at a bound": int(held),
           "coordinator s": executor.coordinator, "us a task": each, "tasks": runner.simulations,
           "intervals s": took, "GB": memory()}  # fmt: skip


@dataclass(frozen=True)
class Wave(Method):
    """Asks for many points at once: what a large population or a Jacobian does."""

    name: ClassVar[str] = "wave"
    needs_residuals: ClassVar[bool] = False

    points: int

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        yield Points(space.start + generator.normal(size=(self.points, space.size)), "wave")
        return Solution(space.start, np.nan, Ending.CONVERGED)


def busy(workers: int, seconds: float, overhead: float) -> tuple[float, float]:
    """The share of busy workers, and the coordinator's seconds for a task."""
    problem = problem_of([Parameter(f"p{i}", 1.0) for i in range(12)], [TIMES] * EXPERIMENTS)
    space = make_space(problem, tuple(range(EXPERIMENTS)))
    answer = np.ones(len(TIMES))
    answered = 0

    def residuals(task: Task) -> FloatArray:
        nonlocal answered
        answered += 1
        return answer.copy()

    def duration(task: Task, generator: np.random.Generator) -> float:
        return seconds * float(generator.uniform(0.5, 1.5))

    def clock() -> float:
        return time.process_time() + overhead * answered

    executor = VirtualExecutor(residuals, duration, workers, clock=clock)
    points = max(1, TASKS_OF_A_WORKER * workers // EXPERIMENTS)
    with tempfile.TemporaryDirectory() as folder:
        keys = [(run.id, run.key) for run in problem.experiments]
        log = EvaluationLog(Path(folder), "none", keys, {})
        runner = Runner(executor, record=log.record)
        runner.run([SearchRequest("wave", Wave(points), space)])
        log.close()
    return executor.busy_share, executor.coordinator / runner.simulations
