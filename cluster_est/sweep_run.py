"""One run of a sweep: a fit on workers that are there already, into a folder of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from cluster_est import rows
from cluster_est.build import (
    build_method,
    build_multistart,
    build_problem,
    build_resources,
    build_uncertainty,
)
from cluster_est.config import Config
from cluster_est.errors import ExecutorError
from cluster_est.executors import Executor
from cluster_est.fit import check_search, complete, refine, simulate_all
from cluster_est.methods.base import Ending
from cluster_est.multistart import search_from_starts
from cluster_est.problem import Problem
from cluster_est.progress import ProgressLine
from cluster_est.resources import one_blas_thread
from cluster_est.result import Result
from cluster_est.run_folder import RunFolder, hash_config
from cluster_est.runner import Budget, Iteration, Note, Runner, Show
from cluster_est.space import make_space
from cluster_est.sweep_matrix import SweepRun
from cluster_est.sweep_pool import SharedPools, pool_key
from cluster_est.sweep_state import Planned, clear_torn, fingerprint
from cluster_est.toml import to_toml
from cluster_est.uncertainty import examine
from workers.messages import content_hash

Progress = Callable[[Budget], AbstractContextManager[ProgressLine]]


def check_run(run: SweepRun, *, allow_code: bool) -> Planned:
    """Read all that a run needs, as a fit does before it begins, and keep only what it hashes to.

    Raises
    ------
    ClusterEstError
        If something is wrong.
    """
    config = run.read()
    problem = build_problem(config, run.config.parent, allow_code=allow_code)
    method, resources = build_method(config), build_resources(config)
    check_search(problem, method, build_uncertainty(config), build_multistart(config))
    make_space(problem, problem.indices("test"))
    budget = {k: v for k, v in config.budget.model_dump().items() if v is not None}
    pool = content_hash([repr(pool_key(problem, resources))])
    ray = (resources.workers, resources.address) if resources.executor == "ray" else None
    return Planned(run, fingerprint(config, problem), budget, pool, ray)


def do_run(
    run: SweepRun, folder: Path, pools: SharedPools, progress: Progress, *, allow_code: bool
) -> str:
    """Fit, write the run folder, and give the run's status.

    A run that fails says why in its run.json and hurts no other one. The exceptions are Ctrl-C and
    an executor without workers, which would hit all: they leave the run to the next call.
    """
    config = run.read()
    problem = build_problem(config, run.config.parent, allow_code=allow_code)
    clear_torn(folder)
    written = _open_folder(folder, problem, config)
    try:
        with progress(build_resources(config).budget) as line:
            executor = pools.open(problem, build_resources(config))
            result = _fit_on(executor, problem, config, written, line.show)
        written.write(result)
    except (KeyboardInterrupt, ExecutorError) as error:
        written.abandon(str(error) or "interrupted", "interrupted")
        raise
    except Exception as error:  # whatever it is, the other runs still can be done
        written.abandon(f"{type(error).__name__}: {error}")
        return "failed"
    return "done" if result.success else "not converged"


def _fit_on(
    executor: Executor, problem: Problem, config: Config, folder: RunFolder, show: Show
) -> Result:
    """What `fit` does once it has opened its executor, but it ends at once when interrupted."""
    begin = time.monotonic()
    method, settings, seed = build_method(config), build_uncertainty(config), config.method.seed
    starts = build_multistart(config)
    train = check_search(problem, method, settings, starts)
    units = {name: each.unit for name, each in problem.describe().variables.items()}
    with one_blas_thread():
        budget = build_resources(config).budget
        runner = Runner(executor, budget, folder.record, show, _stopping(folder.note))
        before = simulate_all(runner, problem, {})
        found = search_from_starts(runner, train, method, starts, seed)
        solution = found.best
        known = examine(runner, train, solution)
        result = complete(runner, train, solution, method, before, units, seed, begin, known)
        each_start, minima = rows.starts_and_minima(train, found)
        result = replace(result, starts=each_start, minima=minima)
        if solution.ending.success:
            result = refine(runner, train, result, method, settings, seed)
        return replace(result, search_seconds=time.monotonic() - begin)


def _stopping(note: Note) -> Note:
    """Let an interrupt through, which a search only notes as its end: no run is to follow."""

    def noted(iteration: Iteration) -> None:
        note(iteration)
        if iteration.progress.ending == Ending.INTERRUPTED.name.lower():
            raise KeyboardInterrupt

    return noted


def _open_folder(path: Path, problem: Problem, config: Config) -> RunFolder:
    tree = config.model_dump(mode="json", exclude_defaults=False)
    return RunFolder(
        path,
        problem,
        to_toml(config.model_dump(mode="python")),
        hash_config(tree, "closed_loop"),
        config.method.seed,
        overwrite=True,
    )
