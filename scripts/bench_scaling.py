"""How far one coordinator goes: its memory, its seconds for an iteration, and its cost of a task.

    python scripts/bench_scaling.py --experiments 10000
    python scripts/bench_scaling.py --virtual 1000 10000

The first fits shared and local unknowns of many experiments with `least_squares` and says what an
iteration costs the coordinator. Nothing is simulated: a formula takes the place of simulations, and
the time that it takes is left out.

The second drives the real runner with workers that are as many as you like and have virtual clocks.
What the coordinator really works, in seconds of this machine's processor, passes on those clocks
too, so workers stand idle where it cannot keep up. `--overhead` adds what sending a task costs on a
cluster, which is not in there.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from virtual_executor import VirtualExecutor

from cluster_est import Experiment, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.methods.method import Ending, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.run_folder.evaluation_log import EvaluationLog
from cluster_est.running.resources import SearchIteration, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import assess
from workers.messages import FloatArray, Task

TIMES = np.linspace(0.1, 3.0, 20)
SHARED = 10
HARMONICS = np.arange(2.0, SHARED + 1.0)
SECONDS = (0.1, 1.0, 10.0)
TASKS_OF_A_WORKER = 30
EXPERIMENTS = 100


def formula(experiment: int, values: FloatArray) -> FloatArray:
    """gain (sin(w t + f) + sum of a_k sin(k t + k f)) + offset, with a phase f of its own."""
    phase = 0.1 * experiment
    shape = np.sin(values[0] * TIMES + phase)
    shape += values[1:SHARED] @ np.sin(HARMONICS[:, None] * (TIMES + phase))
    return np.asarray(values[SHARED] * shape + values[SHARED + 1])


def many_experiments(count: int) -> tuple[Problem, Callable[[Task], FloatArray]]:
    """A problem with 10 shared and 2 x `count` local unknowns, and what answers its tasks."""
    generator = np.random.default_rng(0)
    shared = np.append(0.5, 0.3 * generator.normal(size=SHARED - 1))
    gains, offsets = generator.uniform(0.5, 1.5, count), generator.normal(size=count)
    measured = [
        formula(e, np.array([*shared, gains[e], offsets[e]])) + 0.05 * generator.normal(size=20)
        for e in range(count)
    ]
    parameters = [Parameter("w", 0.6, 0.1, 2.0)]
    parameters += [Parameter(f"a{k}", 0.1, -5.0, 5.0) for k in range(1, SHARED)]
    parameters += [Parameter("gain", 1.0, 0.6, 1.4, per="experiment")]  # one in five at a bound
    parameters += [Parameter("offset", 0.1, -10.0, 10.0, per="experiment")]
    runs = [
        Experiment(f"e{e}", 0.0, 3.0, (), (Output("y", TIMES, values),))
        for e, values in enumerate(measured)
    ]
    names = tuple(p.name for p in parameters)
    model = Model("none", b"", "model_exchange", Solver("rk4"), names)

    def residuals(task: Task) -> FloatArray:
        return measured[task.experiment] - formula(task.experiment, task.values)

    return Problem(model, tuple(parameters), tuple(runs)), residuals


def memory() -> float:
    """The most that this process has had in memory, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def fit_many(count: int) -> None:
    """Fit many experiments; say what it cost the coordinator."""
    problem, residuals = many_experiments(count)
    print(f"{memory():8.2f} GB  data of {count} experiments")
    space = make_space(problem, tuple(range(count)))
    executor = VirtualExecutor(residuals, lambda task, generator: 1.0, 64, clock=time.process_time)
    spent: list[tuple[float, int]] = []

    def note(line: SearchIteration) -> None:
        before = spent[-1] if spent else (0.0, 0)
        spent.append((executor.coordinator, line.evaluations))
        tasks = (line.evaluations - before[1]) * count
        print(
            f"{memory():8.2f} GB  {executor.coordinator - before[0]:6.1f} s, {tasks} tasks; "
            f"iteration {line.progress.iteration}, cost {line.progress.cost:.9g} "
            f"{line.progress.ending}"
        )

    runner = Runner(executor, note=note)
    begin = time.process_time()
    (solution,) = runner.run([SearchRequest("fit", LeastSquares(), space)])
    whole = time.process_time() - begin
    held = np.count_nonzero((solution.x <= space.lower) | (solution.x >= space.upper))
    each = 1e6 * executor.coordinator / runner.simulations
    print(
        f"{solution.ending}; {space.size} unknowns, {held} at a bound; the coordinator worked "
        f"{executor.coordinator:.1f} s, {each:.1f} us for each of {runner.simulations} tasks; the "
        f"formula took {whole - executor.coordinator:.1f} s"
    )
    begin = time.process_time()
    found = assess(space, solution)
    took, spread = time.process_time() - begin, found.intervals[0].std_error
    print(f"intervals: {took:.1f} s; w = {solution.x[0]:.6f} +- {spread:.2g}")
    print(f"{memory():8.2f} GB  at most")


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
    parameters = tuple(Parameter(f"p{i}", 1.0) for i in range(12))
    runs = tuple(
        Experiment(f"e{e}", 0.0, 3.0, (), (Output("y", TIMES, TIMES),)) for e in range(EXPERIMENTS)
    )
    names = tuple(p.name for p in parameters)
    problem = Problem(Model("none", b"", "model_exchange", Solver("rk4"), names), parameters, runs)
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
        log = EvaluationLog(Path(folder), "none", [(run.id, run.key) for run in runs], {})
        runner = Runner(executor, record=log.record)
        runner.run([SearchRequest("wave", Wave(points), space)])
        log.close()
    return executor.busy_share, executor.coordinator / runner.simulations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, help="fit so many experiments")
    parser.add_argument("--virtual", type=int, nargs="+", help="numbers of workers")
    parser.add_argument("--overhead", type=float, default=0.0, help="us more for each task")
    arguments = parser.parse_args()
    with one_blas_thread():
        if arguments.experiments:
            fit_many(arguments.experiments)
        keep_busy(arguments.virtual or [], 1e-6 * arguments.overhead)


def keep_busy(numbers: Sequence[int], overhead: float) -> None:
    """Say which share of so many workers stays busy."""
    for workers in numbers:
        for seconds in SECONDS:
            share, cost = busy(workers, seconds, overhead)
            print(
                f"{workers:6d} workers, simulations of {seconds:4.1f} s: {share:6.1%} busy; the "
                f"coordinator's work is {1e6 * cost:.0f} us a task"
            )


if __name__ == "__main__":
    main()
