"""This project and its peers on one problem: ratios of medians of interleaved runs.

    python scripts/bench_peers.py [--rounds 5] [--skip-ray] [--skip-tools]

Three problems, with the same start, bounds and interface for all. The first is the embedded
example, in co-simulation, as FMPy applies no sampled inputs in model exchange. estim8 has no inputs
and modestpy takes one record, so neither can do it; both can do the second, the one experiment of
the example that has no force. The third is the same in model exchange, where FMPy's CVode and this
project's solver have the same relative tolerance; modestpy offers no choice of the interface.

Every search is timed with its workers standing and its FMU loaded, from the call to the estimates;
a line for this project's whole fit includes loading, uncertainty and curves. Costs are computed
anew at the estimates of each, by one loop around FMPy. "same" says that a cost is the lowest one to
within 1e-6 of it; a tool that ends elsewhere, as modestpy does, counts for no ratio. estim8 and
modestpy are installed into environments of their own under --cache; where they do not install, a
sentence says so.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import platformdirs
import ray
from peers_benchmark import fmpy_fits
from peers_benchmark.case import Case, embedded, free_decay
from peers_benchmark.environments import TOOLS
from peers_benchmark.fmpy_fits import Fit

import cluster_est as ce
from cluster_est.executors import Executor
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.resources import one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

PROCESSES = 2
SAME = 1e-6
WAYS = {
    "cold": "simulate_fmu",
    "reused": "simulate_fmu, instance reused",
    "by_hand": "FMU2Slave in a loop, instance reused",
}


@dataclass
class Contender:
    """One line of the table."""

    label: str
    workers: int
    run: Callable[[], Fit]
    ours: bool = False
    fits: list[Fit] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        return statistics.median(fit.seconds for fit in self.fits)


def main() -> None:
    """Print a table for each problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--skip-ray", action="store_true")
    parser.add_argument("--skip-tools", action="store_true")
    default = Path(platformdirs.user_cache_dir("cluster-est")) / "peers"
    parser.add_argument("--cache", type=Path, default=default)
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes that are started here
    with ExitStack() as stack:
        folder = fmpy_fits.unpack(stack.enter_context(tempfile.TemporaryDirectory()))
        if not options.skip_ray:
            start_ray(stack)
        cases = (embedded(), free_decay("co_simulation"), free_decay("model_exchange"))
        for case in cases:
            with ExitStack() as pools:
                contenders = ours(case, options.skip_ray, pools)
                contenders += by_fmpy(case, folder, pools)
                if len(case.records) == 1 and not options.skip_tools:
                    contenders += by_tools(case, options.cache)
                race(contenders, options.rounds)
            print_table(case, contenders, folder)


def start_ray(stack: ExitStack) -> None:
    """Start Ray on this machine, for all fits."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray.init("local", num_cpus=PROCESSES, include_dashboard=False, log_to_driver=False)
    stack.callback(ray.shutdown)


def ours(case: Case, skip_ray: bool, executors: ExitStack) -> list[Contender]:
    """This project: the search on one thread and on two Ray workers, and a whole fit."""
    found = []
    for label, resources in (
        ("cluster-est, local", ce.Resources()),
        ("cluster-est, Ray", ce.Resources("ray", PROCESSES)),
    ):
        if resources.executor == "ray" and skip_ray:
            continue
        executor = executors.enter_context(open_executor(case.problem, resources))
        run = partial(search, case, executor)
        found.append(Contender(label, executor.workers, run, ours=True))
    whole = partial(whole_fit, case)
    return [*found, Contender("cluster-est, local, a whole fit", 1, whole, ours=True)]


def search(case: Case, executor: Executor) -> Fit:
    """Minimise with workers that stand, which is what SciPy does too."""
    simulated = []
    with one_blas_thread():
        begin = time.perf_counter()
        space = make_space(case.problem, tuple(range(len(case.problem.experiments))))
        runner = Runner(executor, record=lambda origin, outcome: simulated.append(outcome.task))
        (solution,) = runner.run([SearchRequest("bench", ce.LeastSquares(), space)])
        seconds = time.perf_counter() - begin
    return Fit(tuple(solution.x.tolist()), seconds, len(simulated))  # all scales are linear


def whole_fit(case: Case) -> Fit:
    """Load the FMU, minimise, and compute the uncertainty and all curves before and after."""
    begin = time.perf_counter()
    result = ce.fit(case.problem)
    seconds = time.perf_counter() - begin
    return Fit(tuple(result.solution.x.tolist()), seconds, result.simulated)


def by_fmpy(case: Case, folder: str, pools: ExitStack) -> list[Contender]:
    """SciPy around FMPy, each way in this process and with a pool of two."""
    found = []
    context = multiprocessing.get_context("spawn")
    for way, label in WAYS.items():
        if way == "by_hand" and case.interface == "model_exchange":
            continue  # it would need a solver of its own
        pool = pools.enter_context(context.Pool(PROCESSES, fmpy_fits.prepare, (case, folder, way)))
        for workers, used in ((1, None), (PROCESSES, pool)):
            how = "" if used is None else ", workers=pool.map"
            run = partial(fmpy_fits.fit, case, folder, way, used)
            found.append(Contender(f"least_squares{how}; {label}", workers, run))
    return found


def by_tools(case: Case, cache: Path) -> list[Contender]:
    """Tools in environments of their own, where they install."""
    found = []
    for tool in [tool for tool in TOOLS if case.interface in tool.interfaces]:
        problem = tool.install(cache)
        if problem:
            print(problem)
        else:
            run = partial(tool.run, case, cache)
            found.append(Contender(f"{tool.name} ({tool.requirements[0]})", 1, run))
    return found


def race(contenders: list[Contender], rounds: int) -> None:
    """Run all by turns, once more than counts: the first run compiles and fills caches."""
    for _ in range(rounds + 1):
        for contender in contenders:
            contender.fits.append(contender.run())
    for contender in contenders:
        del contender.fits[0]


def print_table(case: Case, contenders: list[Contender], folder: str) -> None:
    """Print one line each, and the ratio that counts."""
    costs = [fmpy_fits.cost(case, folder, contender.fits[-1].values) for contender in contenders]
    best = min(costs)
    local = contenders[0].seconds
    width = max(len(contender.label) for contender in contenders)
    print(f"\n{case.title}; start {dict(zip(case.unknowns, case.start, strict=True))}")
    print(
        f"{'what is run':{width}s}  workers  simulations      final cost  same   median s     ratio"
    )
    peers = []
    for contender, cost in zip(contenders, costs, strict=True):
        same = cost <= best * (1.0 + SAME)
        if same and not contender.ours:
            peers.append(contender)
        simulations = contender.fits[-1].simulations
        count = "not told" if simulations is None else str(simulations)
        print(
            f"{contender.label:{width}s}  {contender.workers:7d}  {count:>11s}  {cost:14.9g}"
            f"  {'yes' if same else 'no':>4s}  {contender.seconds:9.4f}"
            f"  {contender.seconds / local:8.1f}"
        )
    if peers:
        fastest = min(peers, key=lambda contender: contender.seconds)
        print(f"fastest peer / cluster-est, local: {fastest.seconds / local:.1f} ({fastest.label})")


if __name__ == "__main__":
    main()
