"""One run of a sweep: a fit on workers that are there already, into a folder of its own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from cluster_est.cli.printing import read_facts
from cluster_est.cli.progress import ProgressLine
from cluster_est.config.build import build_problem
from cluster_est.config.options import build_method
from cluster_est.config.reader import Config
from cluster_est.config.settings import build_multistart, build_resources, build_uncertainty
from cluster_est.errors import ExecutorError, RunFolderError
from cluster_est.executors import Executor
from cluster_est.executors.log_replay import LogReplayExecutor
from cluster_est.fit import check_search, fit_on
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import make_space
from cluster_est.results.result import Result
from cluster_est.run_folder.folder import RunFolder
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.run_folder.resume import check_resumable, open_folder
from cluster_est.running.resources import one_blas_thread
from cluster_est.running.runner import Budget, Runner, Show
from cluster_est.sweep.matrix import SweepRun
from cluster_est.sweep.pool import SharedPools, pool_key
from cluster_est.sweep.state import PlannedRun, clear_torn, fingerprint
from workers.messages import content_hash

UNUSED = "closed_loop"
"""The section of a config that does not concern a fit."""
UNDER_WAY = ("running", "interrupted")
Progress = Callable[[Budget], AbstractContextManager[ProgressLine]]


def check_run(run: SweepRun, *, allow_code: bool) -> PlannedRun:
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
    return PlannedRun(run, fingerprint(config, problem), budget, pool, ray)


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
    logged = _find_log(folder, problem, config)
    written = open_folder(
        folder,
        problem,
        config,
        UNUSED,
        overwrite=logged is None,
        logged=logged,
        base=run.config.parent,
    )
    try:
        with progress(build_resources(config).budget) as line:
            executor = pools.open(problem, build_resources(config))
            if logged is not None:
                executor = LogReplayExecutor(executor, problem.model, problem.experiments, logged)
            result = _fit_on(executor, problem, config, written, line.show)
        written.write(result)
        if result.interrupted:
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise
    except ExecutorError as error:
        written.abandon(str(error), "interrupted")
        raise
    except Exception as error:  # whatever it is, the other runs still can be done
        written.abandon(f"{type(error).__name__}: {error}")
        return "failed"
    return "done" if result.success else "not converged"


def _find_log(folder: Path, problem: Problem, config: Config) -> LoggedOutcomes | None:
    """What a run had simulated that was under way when its sweep ended; None to begin anew."""
    if not (folder / "run.json").is_file():
        return None
    try:
        resumed = read_facts(folder)["status"] in UNDER_WAY
        if resumed and check_resumable(folder, problem, config, UNUSED):
            return LoggedOutcomes(folder / "evaluations")
    except RunFolderError:  # it was a run of something else
        pass
    return None


def _fit_on(
    executor: Executor, problem: Problem, config: Config, folder: RunFolder, show: Show
) -> Result:
    """A fit on these workers."""
    method, settings = build_method(config), build_uncertainty(config)
    starts = build_multistart(config)
    train = check_search(problem, method, settings, starts)
    with one_blas_thread():
        budget = build_resources(config).budget
        runner = Runner(executor, budget, folder.record, show, folder.note)
        return fit_on(runner, train, method, config.method.seed, starts, settings)
