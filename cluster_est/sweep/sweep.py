"""Executes a sweep: one kind of study for many configs, which can be continued."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster_est.config.choices import build_resources
from cluster_est.errors import (
    ClusterEstError,
    ConfigError,
    ExecutorError,
    RunFolderError,
    UnsuitableExecutorError,
)
from cluster_est.executors import executor_class
from cluster_est.run_folder.context import ExistingRun
from cluster_est.run_folder.lock import locked_by_sweep
from cluster_est.run_folder.resume import check_resumable
from cluster_est.run_folder.run_files import RunStatus, RunWorth, read_facts, run_worth
from cluster_est.run_folder.run_identity import RunIdentity
from cluster_est.running.environment import SharedPools, pool_key
from cluster_est.studies.configured import ConfiguredStudy, Destination, Listener, configure, do_run
from cluster_est.sweep.history import add_to_history
from cluster_est.sweep.matrix import (
    FAILED_STATES,
    NOT_RUN,
    PlannedRun,
    SweepRun,
    check_folder,
    clear_torn,
    fingerprint,
    read_sweep,
    status,
    summary_rows,
    write_state,
    write_summary,
)
from workers.messages import content_hash

UNDER_WAY = (RunStatus.RUNNING, RunStatus.INTERRUPTED)


def read_sweep_run(run: SweepRun, *, allow_code: bool) -> ConfiguredStudy:
    """Read and check all inputs of a run.

    Raises
    ------
    ClusterEstError
        If an input is invalid.
    """
    return configure(run.read(), run.config, run.study, allow_code=allow_code)


def check_run(run: SweepRun, *, allow_code: bool) -> PlannedRun:
    """Read and check all inputs of a run, and return their hashes.

    Raises
    ------
    ClusterEstError
        If an input is invalid.
    """
    configured = read_sweep_run(run, allow_code=allow_code)
    identity, config = configured.identity, configured.config
    resources = build_resources(config)
    budget = {k: v for k, v in config.budget.model_dump().items() if v is not None}
    pool = content_hash([repr(pool_key(identity.problem, resources))])
    shared = executor_class(resources.executor).on_cluster
    cluster = (resources.executor, resources.workers, resources.address) if shared else None
    return PlannedRun(run, fingerprint(identity), budget, pool, cluster)


def do_sweep_run(
    run: SweepRun, folder: Path, pools: SharedPools, listener: Listener, *, allow_code: bool
) -> RunStatus:
    """Execute a run, write its folder, and return its status.

    The reason of a failure is in run.json. A failed run does not affect the other runs.

    Raises
    ------
    ExecutorError, RunFolderError
        If no workers can be started, or the folder cannot be written, because all runs would then
        fail. The next call continues.
    """
    configured = read_sweep_run(run, allow_code=allow_code)
    clear_torn(folder)
    existing = (
        ExistingRun.RESUME if _is_under_way(folder, configured.identity) else ExistingRun.OVERWRITE
    )
    to = Destination(folder, existing, report=False, begin_at_once=True)
    try:
        return do_run(configured, to, listener, pools).status
    except UnsuitableExecutorError:  # other FMUs may run with this executor
        return RunStatus.FAILED
    except (ExecutorError, RunFolderError):
        raise
    except Exception:  # the reason is in run.json; the other runs can still be executed
        return RunStatus.FAILED


def _is_under_way(folder: Path, identity: RunIdentity) -> bool:
    """Return whether the folder contains an unfinished execution of this run."""
    if not (folder / "run.json").is_file():
        return False
    try:
        return read_facts(folder)["status"] in UNDER_WAY and check_resumable(folder, identity)
    except RunFolderError:  # the folder belongs to another run
        return False


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep.

    Attributes
    ----------
    rows
        Rows of summary.parquet, one for each run.
    ran
        Number of runs that this call executed.
    interrupted
        Whether the call was interrupted, for example by Ctrl-C; the next call continues.
    """

    rows: list[dict[str, Any]]
    ran: int
    interrupted: bool

    @property
    def success(self) -> bool:
        """Whether every run has reached a solution without doubts, in this or an earlier call."""
        worths = {run_worth(row["status"], row["doubts"]) for row in self.rows}
        return worths <= {RunWorth.GOOD}


def sweep(
    path: Path,
    out: Path,
    tell: Callable[[str], None],
    listener: Listener,
    *,
    retry_failed: bool = False,
    allow_code: bool = False,
) -> SweepResult:
    """Execute every run of a sweep that has not been executed yet.

    All runs are checked before the first one starts. They run one after the other, each on all
    workers. Runs with the same model and experiments are grouped and share their workers, and all
    runs with Ray share one Ray cluster. A run is skipped if its folder contains a solution for the
    same config, data, FMU and versions. A failed run is repeated if one of these or its budget has
    changed.

    Parameters
    ----------
    path
        The sweep file.
    out
        Folder for the run folders, summary.parquet, history.parquet and sweep.json.
    tell
        Called with a line for each run that ended.
    listener
        Receives messages and progress of each run.
    retry_failed
        Whether to repeat failed runs even if nothing has changed.
    allow_code
        Whether Python functions that are named in configs may run.

    Raises
    ------
    ConfigError
        If the sweep, a config or its data have errors; the message lists all of them.
    RunFolderError
        If the folder is not that of a sweep, or another process uses it.
    ExecutorError
        If no workers can be started; the next call continues.
    """
    runs = read_sweep(path)
    check_folder(out)
    plan = _check_all(runs, allow_code=allow_code)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"{out}: cannot be created ({error}); choose another folder"
        ) from error
    with locked_by_sweep(out):
        states = {p.run.name: status(out / p.run.name, p) for p in plan}
        again = FAILED_STATES if retry_failed else ()
        todo = [p for p in plan if states[p.run.name] in (NOT_RUN, *again)]
        try:
            with SharedPools() as pools:
                ran = 0
                for run in _pooled(todo):
                    states[run.name] = NOT_RUN
                    write_state(out, path, states, running=run.name)
                    try:
                        found = do_sweep_run(
                            run, out / run.name, pools, listener, allow_code=allow_code
                        )
                    except KeyboardInterrupt:
                        break
                    if found is RunStatus.INTERRUPTED:
                        break
                    states[run.name] = found
                    ran += 1
                    tell(f"[{ran}/{len(todo)}] {run.name}: {found}")
        finally:
            write_state(out, path, states)
            rows = summary_rows(out, plan, states)
            write_summary(out, rows)
            add_to_history(out, rows)
    return SweepResult(rows, ran, interrupted=ran < len(todo))


def _pooled(todo: list[PlannedRun]) -> list[SweepRun]:
    """Return the runs in order, but grouped by their workers."""
    together: dict[str, list[SweepRun]] = defaultdict(list)
    for planned in todo:
        together[planned.pool].append(planned.run)
    return [run for each in together.values() for run in each]


def _check_all(runs: list[SweepRun], *, allow_code: bool) -> list[PlannedRun]:
    """Check every run; an error of several runs is reported once, with their names."""
    plan: list[PlannedRun] = []
    wrong: dict[str, list[str]] = defaultdict(list)
    for run in runs:
        try:
            plan.append(check_run(run, allow_code=allow_code))
        except ClusterEstError as error:
            for line in str(error).splitlines():
                wrong[line].append(run.name)
    for problem, names in _disagreements(plan).items():
        wrong[problem] += names
    if wrong:
        lines = [f"{_listed(names)}: {line}" for line, names in wrong.items()]
        raise ConfigError("\n".join(lines))
    return plan


def _disagreements(plan: list[PlannedRun]) -> dict[str, list[str]]:
    """Return errors for runs with another cluster than the first run with the same executor."""
    first: dict[str, PlannedRun] = {}
    wrong: dict[str, list[str]] = defaultdict(list)
    for planned in plan:
        if planned.cluster is None:
            continue
        executor = planned.cluster[0]
        known = first.setdefault(executor, planned)
        if planned.cluster != known.cluster:
            problem = (
                f'executor: workers and address must be the same in all runs with "{executor}" '
                "(the runs share the executor), but they differ from those of "
                f"{known.run.name}; set them in [overrides]"
            )
            wrong[problem].append(planned.run.name)
    return wrong


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"run{'s' if len(names) > 1 else ''} {', '.join(names[:3])}{more}"
