"""A hundred real workers on a small machine: simulations that sleep need no core.

    python scripts/bench_actors.py [--workers 100] [--seconds 300] [--kill 0] [--simulation 0.1]

The FMU waits after each of its steps, so one simulation takes as long as it is told and hardly any
processor time. Each worker is a Ray actor with an FMU of its own. Printed are the start-up time,
the share of time in which workers were busy, tasks a second, the coordinator's share of a core,
memory for each worker, and, with `--kill` actors killed a minute, whether costs have the same bits.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cluster_est as ce
from cluster_est.methods.given_points import GivenPoints
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.resources import one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

ROOT = Path(__file__).resolve().parent.parent
STEPS = 1
EXPERIMENTS = 10


def make_problem(fmu: Path, seconds: float) -> ce.Problem:
    """Decays whose FMU sleeps `seconds` in each simulation."""
    times = np.linspace(0.0, 2.0, STEPS + 1)
    model = ce.read_model(fmu, ["k"], solver=ce.Solver("rk4", step=2.0 / STEPS))
    runs = []
    for e in range(EXPERIMENTS):
        output = ce.Output("y", times, np.exp(-(0.5 + 0.1 * e) * times))
        known = (("delay", seconds / STEPS),)
        runs.append(ce.Experiment(f"e{e}", 0.0, 2.0, (), (output,), known))
    return ce.Problem(model, (ce.Parameter("k", 1.0, 0.01, 10.0),), tuple(runs))


def actors() -> list[int]:
    """Processes of Ray actors."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if words.startswith(b"ray::FmuActor"):  # a node ends with its agents
                found.append(int(entry.name))
    return found


def memory_of(pid: int) -> float:
    """The memory that is a process's own, MB."""
    try:
        lines = (Path("/proc") / str(pid) / "smaps_rollup").read_text().splitlines()
    except OSError:
        return np.nan
    own = [int(line.split()[1]) for line in lines if line.startswith("Private")]
    return sum(own) / 1024.0


def kill_some(every: float, stop: threading.Event) -> None:
    """Kill an actor now and then."""
    generator = np.random.default_rng(0)
    while not stop.wait(every):
        found = actors()
        if found:
            os.kill(int(generator.choice(found)), signal.SIGKILL)


def measure(problem: ce.Problem, given: argparse.Namespace) -> NDArray[np.float64]:
    """Simulate for as long as was asked, and print what it took."""
    points = max(int(given.seconds * given.workers / given.simulation / EXPERIMENTS), 1)
    x = np.random.default_rng(1).uniform(0.1, 2.0, (points, 1))
    resources = ce.Resources("ray", workers=given.workers)
    begin = time.monotonic()
    with one_blas_thread(), open_executor(problem, resources) as pool:
        runner = Runner(pool)
        space = make_space(problem, tuple(range(EXPERIMENTS)))
        seen: set[str] = set()
        generator = np.random.default_rng(2)
        while len(seen) < given.workers:
            warm = GivenPoints(generator.uniform(0.1, 2.0, (2 * given.workers, 1)), "first")
            (first,) = runner.run([SearchRequest("first", warm, space)])
            seen |= {o.worker for each in first.evaluations for o in each.outcomes}
        print(f"start-up {time.monotonic() - begin:.1f} s until all had simulated", flush=True)
        stop = threading.Event()
        if given.kill:
            killer = threading.Thread(target=kill_some, args=(60.0 / given.kill, stop), daemon=True)
            killer.start()
        began, used = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF)
        (found,) = runner.run([SearchRequest("points", GivenPoints(x, "points"), space)])
        seconds, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_SELF)
        stop.set()
        own = [memory_of(pid) for pid in actors()]
    work = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
    tasks = points * EXPERIMENTS
    busy = sum(o.seconds for each in found.evaluations for o in each.outcomes)
    print(
        f"{tasks} tasks in {seconds:.1f} s: {tasks / seconds:.0f} a second; busy "
        f"{100.0 * busy / (seconds * given.workers):.1f} %; coordinator "
        f"{work / seconds:.2f} cores, {1e6 * work / tasks:.0f} us a task; memory of each actor "
        f"{np.nanmedian(own):.0f} MB; failures {runner.failures}",
        flush=True,
    )
    return np.array([each.cost for each in found.evaluations])


def main() -> None:
    """Measure without and, if asked for, with actors that are killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--simulation", type=float, default=0.1, help="seconds of one")
    parser.add_argument("--kill", type=int, default=0, help="actors killed a minute")
    given = parser.parse_args()
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "scripts")]
    from fmus.build import build

    with tempfile.TemporaryDirectory() as folder:
        problem = make_problem(build("slow", 2, Path(folder)), given.simulation)
        kills, given.kill = given.kill, 0
        costs = measure(problem, given)
        if kills:
            given.kill = kills
            again = measure(problem, given)
            print("same bits" if np.array_equal(costs, again) else "other bits")


if __name__ == "__main__":
    main()
