"""One run of a sweep: the recipe of every run, on workers that are there already."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cluster_est.config.options import build_resources
from cluster_est.configured_run import (
    ConfiguredRun,
    Destination,
    Listener,
    configure,
    do_run,
)
from cluster_est.errors import ExecutorError, RunFolderError, UnsuitableExecutorError
from cluster_est.executors import executor_class
from cluster_est.run_folder.context import Existing
from cluster_est.run_folder.reading import read_facts
from cluster_est.run_folder.resume import check_resumable
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.run_folder.run_status import RunStatus
from cluster_est.running.shared_pools import SharedPools, pool_key
from cluster_est.sweep.matrix import SweepRun
from cluster_est.sweep.state import PlannedRun, clear_torn, fingerprint
from workers.messages import content_hash

UNDER_WAY = (RunStatus.RUNNING, RunStatus.INTERRUPTED)


@dataclass(frozen=True)
class SweepSettings:
    """Workers, listener and permissions that all runs of a sweep share.

    Attributes
    ----------
    pools
        The workers that they share.
    listener
        Hears of each run while it goes on.
    allow_code
        Whether Python functions that configs name may run.
    """

    pools: SharedPools
    listener: Listener
    allow_code: bool


def read_sweep_run(run: SweepRun, *, allow_code: bool) -> ConfiguredRun:
    """Read and check all that a run needs.

    Raises
    ------
    ClusterEstError
        If something is wrong.
    """
    return configure(run.read(), run.config.parent, RunKind.FIT, allow_code=allow_code)


def check_run(run: SweepRun, *, allow_code: bool) -> PlannedRun:
    """Read and check all that a run needs, and keep only what it hashes to.

    Raises
    ------
    ClusterEstError
        If something is wrong.
    """
    configured = read_sweep_run(run, allow_code=allow_code)
    identity, config = configured.identity, configured.config
    resources = build_resources(config)
    budget = {k: v for k, v in config.budget.model_dump().items() if v is not None}
    pool = content_hash([repr(pool_key(identity.problem, resources))])
    shared = executor_class(resources.executor).on_cluster
    cluster = (resources.executor, resources.workers, resources.address) if shared else None
    return PlannedRun(run, fingerprint(identity), budget, pool, cluster)


def do_sweep_run(run: SweepRun, folder: Path, settings: SweepSettings) -> RunStatus:
    """Do a run into its folder, and return its status.

    A run that fails says why in its run.json and hurts no other one.

    Raises
    ------
    ExecutorError, RunFolderError
        If there are no workers to be had, or its folder cannot be written, which would hit all
        runs; the next call goes on.
    """
    configured = read_sweep_run(run, allow_code=settings.allow_code)
    clear_torn(folder)
    existing = Existing.RESUME if _is_under_way(folder, configured.identity) else Existing.OVERWRITE
    to = Destination(folder, existing, report=False, begin_at_once=True)
    try:
        return do_run(configured, to, settings.listener, settings.pools).status
    except UnsuitableExecutorError:  # for this FMU; others may run there
        return RunStatus.FAILED
    except (ExecutorError, RunFolderError):
        raise
    except Exception:  # whatever it is stands in its run.json; the other runs still can be done
        return RunStatus.FAILED


def _is_under_way(folder: Path, identity: RunIdentity) -> bool:
    """Return whether the folder holds this run as it was when its sweep ended."""
    if not (folder / "run.json").is_file():
        return False
    try:
        return read_facts(folder)["status"] in UNDER_WAY and check_resumable(folder, identity)
    except RunFolderError:  # it was a run of something else
        return False
