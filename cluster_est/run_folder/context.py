"""The folder of a run during the run: opened, updated, and closed in every case."""

from __future__ import annotations

import enum
from collections.abc import Callable
from pathlib import Path
from typing import Self

from cluster_est.errors import BudgetError, ClusterEstError, ExecutorError, UnwritableError
from cluster_est.run_folder.lock import RunLock
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.run_folder.resume import check_resumable, is_finished
from cluster_est.run_folder.run_files import RunStatus, read_facts
from cluster_est.run_folder.run_folder import RunFolder, RunResult, check_free
from cluster_est.run_folder.run_identity import RunIdentity
from cluster_est.running.environment import EarlierRun, Monitor
from cluster_est.running.progress_line import search_title
from cluster_est.running.reset_policy import ResetDecision, recorded
from cluster_est.running.resources import RunSnapshot, SearchIteration, Show, TaskOrigin
from workers.messages import Outcome


class ExistingRun(enum.Enum):
    """Treatment of a run that exists already in the folder."""

    REFUSE = enum.auto()
    OVERWRITE = enum.auto()
    RESUME = enum.auto()


class RunContext:
    """Manages the folder of one run.

    The folder is opened at the first simulation, so that invalid input creates no files.

    Parameters
    ----------
    identity
        Identity of the run.
    out
        The folder.
    existing
        Treatment of an existing run; a resumed run must have the same identity.
    say
        Called with sentences for the user.

    Attributes
    ----------
    out
        Path of the folder.
    folder
        None until the first simulation has ended.
    finished
        Whether the existing run is already finished.
    earlier
        Data of an interrupted run.

    Raises
    ------
    RunFolderError
        If the folder contains files that may not be replaced, or a run of another problem.
    """

    def __init__(
        self, identity: RunIdentity, out: Path, existing: ExistingRun, say: Callable[[str], None]
    ) -> None:
        self._identity, self.out, self._say = identity, out, say
        self._overwrite = existing is ExistingRun.OVERWRITE
        self._logged: LoggedOutcomes | None = None
        self._reset: ResetDecision | None = None
        self._searches: dict[str, None] = {}
        self.folder: RunFolder | None = None
        self.finished = False
        self.earlier: EarlierRun | None = None
        self._lock: RunLock | None = None
        is_there = existing is ExistingRun.RESUME and check_resumable(out, identity)
        if existing is not ExistingRun.RESUME:
            check_free(out, overwrite=self._overwrite)
        self.finished = is_there and is_finished(out)
        if self.finished:
            self._say(f"the run in {out} is already finished")
        elif (out / "evaluations").is_dir():
            self._lock = RunLock(out / "evaluations")
        if is_there and not self.finished:
            self._take_up()

    def _take_up(self) -> None:
        """Continue the existing run."""
        self._logged = LoggedOutcomes(self.out / "evaluations")
        self.earlier = EarlierRun(self._logged, recorded(read_facts(self.out)))
        count = len(self._logged)
        self._say(f"the run in {self.out} is resumed; its log has {count} simulations")
        if self._logged.damaged:
            lost = self._logged.lost
            what = f"{lost} more simulations are" if lost else "a part of it is"
            self._say(f"the log was damaged: {what} lost and will be repeated")

    def begin(self) -> RunFolder:
        """Open the folder, if it is not open yet."""
        if self.folder is None:
            self.folder = RunFolder(
                self.out,
                self._identity,
                self._logged,
                overwrite=self._overwrite,
                held=self._lock,
                say=self._say,
            )
            if self._reset is not None:
                self.folder.note_reset(self._reset)
        return self.folder

    def monitor(self, show: Show) -> Monitor:
        """Return a monitor that stores events in the folder, and passes snapshots to `show`."""

        def both(snapshot: RunSnapshot) -> None:
            show(snapshot)
            if self.folder is not None:
                self.folder.show(snapshot)

        return Monitor(self._record, both, self._note, self._note_reset, self._reached)

    def finish(self, result: RunResult) -> RunStatus:
        """Write all tables, and return the status of the run."""
        if self._logged is not None and self._logged.differing:
            self._say(
                f"{self._logged.differing} of the repeated simulations gave residuals that differ "
                "from the logged ones (by their hashes). So the FMU or the machine does not repeat "
                "simulations bit for bit, and the result may differ from that of an uninterrupted "
                "run"
            )
        return self.begin().write(result)

    @property
    def has_results(self) -> bool:
        """Whether there was an intermediate result before the run ended."""
        return self.folder is not None and self.folder.has_results

    @property
    def steps(self) -> str:
        """Progress of the run, as part of a sentence."""
        if not self._searches:
            return "stopped before the first simulation"
        *done, last = dict.fromkeys(search_title(name) for name in self._searches)
        return f"stopped while {last}" + (f", after {', '.join(done)}" if done else "")

    def _record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        folder = self.begin()
        self._searches.pop(origin.search, None)
        self._searches[origin.search] = None
        folder.record(origin, outcome)

    def _reached(self, result: RunResult) -> None:
        """Write an intermediate result, in case the run ends early."""
        self.begin().keep(result)

    def _note(self, iteration: SearchIteration) -> None:
        if self.folder is not None:
            self.folder.note(iteration)

    def _note_reset(self, decision: ResetDecision) -> None:
        self._reset = decision
        if self.folder is not None:
            self.folder.note_reset(decision)
        if not decision.plain:
            self._say(decision.sentence)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        """Write to the run folder how a run ended that was stopped by an exception."""
        if self.folder is not None and error is not None:
            reason, status = _ending(error)
            if self.has_results and isinstance(error, BudgetError):
                status = RunStatus.INTERRUPTED
            self.folder.abandon(f"{reason}; {self.steps}", status)
        elif self.folder is None and self._lock is not None:
            self._lock.release()


def _ending(error: BaseException) -> tuple[str, RunStatus]:
    """Return why a run ended, and its status; a run that may be resumed is interrupted."""
    if isinstance(error, KeyboardInterrupt):
        return RunStatus.INTERRUPTED, RunStatus.INTERRUPTED
    if isinstance(error, ExecutorError | UnwritableError | OSError):
        return str(error), RunStatus.INTERRUPTED
    if isinstance(error, ClusterEstError):
        return str(error), RunStatus.FAILED
    return f"{type(error).__name__}: {error}", RunStatus.FAILED
