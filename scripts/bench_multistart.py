"""A multi-start on two Ray workers: how busy it keeps them, and whether it finds every minimum.

    python scripts/bench_multistart.py [--starts 32] [--workers 2] [--step 5e-4]

The model is a two-mass drive of the closed-loop benchmark with six parameters and four experiments,
integrated with a short fixed step. The share of busy time is that of workers.parquet. Then each
start is fitted alone, in this process, and the minima are compared.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from closed_loop_benchmark.data import make
from closed_loop_benchmark.problem import make_problem
from closed_loop_benchmark.scenarios import all_scenarios

import cluster_est as ce
from cluster_est.fit import fit
from cluster_est.problem.search_space.space import make_space
from cluster_est.run_folder.folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.environment import open_executor
from cluster_est.running.multistart import Multistart, make_starts, search_from_starts
from cluster_est.running.resources import Resources, one_blas_thread
from cluster_est.running.runner import Runner

SYSTEM, PARAMETERS, EXPERIMENTS = "two_mass_drive", 6, 4
WIDER = 100.0


def main() -> None:
    """Print the share of busy time of each worker, and the minima found in both ways."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--step", type=float, default=5e-4)
    parser.add_argument("--at-once", type=int, default=16)
    parser.add_argument("--skip-apart", action="store_true", help="no separate fits")
    options = parser.parse_args()
    problem = make_drive(options.step)
    multistart = Multistart(n=options.starts, at_once=options.at_once)
    with tempfile.TemporaryDirectory() as folder:
        together = in_one_queue(problem, multistart, options.workers, Path(folder) / "run")
    if not options.skip_apart:
        compare(together, one_by_one(problem, multistart))


def make_drive(step: float) -> ce.Problem:
    """A clean case of the benchmark, of which some parameters are kept and some runs left out."""
    name = next(c.name for c in all_scenarios() if c.name.startswith(f"{SYSTEM}/clean"))
    (case,) = [case for case in all_scenarios() if case.name == name]
    problem = make_problem(make(case))
    free = [p for p in problem.parameters if p.per is None][:PARAMETERS]
    kept = tuple(_widened(p, fixed=p not in free) for p in problem.parameters)
    runs = tuple(replace(e, role="train") for e in problem.experiments[:EXPERIMENTS])
    model = replace(problem.model, solver=ce.Solver("rk4", step=step))
    return replace(problem, model=model, parameters=kept, experiments=runs)


def _widened(parameter: ce.Parameter, *, fixed: bool) -> ce.Parameter:
    """Bounds so wide that there is more than one minimum between them."""
    if fixed or parameter.scale != "log":
        return replace(parameter, fixed=fixed)
    return replace(parameter, lower=parameter.lower / WIDER, upper=parameter.upper * WIDER)


def in_one_queue(
    problem: ce.Problem, multistart: Multistart, workers: int, path: Path
) -> list[np.ndarray]:
    """Fit from all starts at once on Ray; what each found."""
    folder = RunFolder(path, RunIdentity(RunKind.FIT, problem, "", "bench", 0))
    result = fit(
        problem,
        resources=Resources("ray", workers),
        record=folder.record,
        note=folder.note,
        multistart=multistart,
    )
    folder.write(result)
    for row in pq.read_table(path / "workers.parquet").to_pylist():
        if row["simulations"] > workers:
            share = row["busy_seconds"] / row["seconds"]
            print(
                f"{row['worker']}: busy {share:.1%} of {row['seconds']:.1f} s, "
                f"{row['simulations']:.0f} simulations of "
                f"{1e3 * row['busy_seconds'] / row['simulations']:.1f} ms"
            )
    print(f"{result.evaluations} evaluations, {result.simulated} simulations")
    minima: dict[int, dict[str, float]] = {}
    for row in result.minima:
        minima.setdefault(row.point, {"cost": row.cost})[row.label] = row.value
    return [np.array(list(values.values())) for values in minima.values()]


def one_by_one(problem: ce.Problem, multistart: Multistart) -> list[np.ndarray]:
    """Fit from each start alone, in this process; the different minima."""
    space = make_space(problem, problem.indices("train"))
    found: list[np.ndarray] = []
    with one_blas_thread(), open_executor(problem, Resources()) as executor:
        starts = make_starts(Runner(executor), space, multistart)
        for x in starts:
            alone = search_from_starts(
                Runner(executor), space.starting_at(x), ce.LeastSquares(), Multistart(), 0
            )
            if alone.minima:
                values = space.estimates(alone.best.x).values()
                found.append(np.array([alone.best.cost, *values]))
    return found


def compare(together: list[np.ndarray], apart: list[np.ndarray]) -> None:
    """Print whether each fit that was run alone ended at a minimum that is known."""
    known = np.array(together)
    print(f"{len(together)} different minima, costs {np.array2string(known[:8, 0], precision=6)}")
    missed = 0
    for values in apart:
        distance = np.max(np.abs(known - values) / np.maximum(np.abs(values), 1e-12), axis=1)
        missed += bool(distance.min() > 1e-2)
    print(f"{len(apart)} separate fits reached a minimum; {missed} of them one that is not known")


if __name__ == "__main__":
    main()
