"""Simulations in a separate process, so that a crash, a hang or a leak affects only that process.

A batch is sent to a forked process. If the process dies or must be ended, each task is simulated
again alone. A task that has failed twice, the last time in a new process, gets an outcome with the
reason. For some time after a failure, tasks are sent one by one, so that the next failure affects
no other task.

No simulation is ended because others were faster or because the machine is busy. The solvers count
steps (`Solver.max_steps`), and `workers.process.progress_watch` distinguishes a stalled process
from a waiting one. Only `Limits.seconds` is measured in wall-clock time.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection

from workers.errors import ModelError
from workers.fmu.process_environment import resident_bytes
from workers.messages import USUAL, Experiment, Limits, Model, Outcome, Status, Task
from workers.process.forked import BatchReport, ForkClient
from workers.process.progress_watch import ProgressWatch
from workers.wire import TaskBatch

LOAD_SECONDS = 300.0
"""Longest time without progress, in seconds, outside of a simulation: while the FMU is loaded, or
outputs are compared with measurements."""


@dataclass(frozen=True)
class ProcessFailure:
    """The reason why a process did not answer."""

    status: Status
    message: str

    @property
    def from_outside(self) -> bool:
        """Whether another program ended the process, so the simulation is not the cause."""
        return self.status is Status.LOST_WORKER


def too_late(watch: ProgressWatch, limits: Limits) -> ProcessFailure | None:
    """Return why a simulation must be stopped; None to continue."""
    if watch.simulated > limits.seconds:
        return ProcessFailure(
            Status.TIMEOUT,
            f"the simulation did not end within {limits.seconds:.3g} s and was stopped; if it only "
            "needs more time, raise executor.timeout",
        )
    if not watch.simulates:
        return _too_late_outside(watch, max(limits.stall, LOAD_SECONDS))
    most = limits.stall
    if watch.still > most:
        return ProcessFailure(
            Status.TIMEOUT,
            f"the simulation stalled: no step ended for {most:.3g} s, so it was stopped; check "
            "that the FMU does not wait for a licence or a window, or raise executor.stall if one "
            "step can take so long",
        )
    return None


def _too_late_outside(watch: ProgressWatch, most: float) -> ProcessFailure | None:
    """Return the failure of a process without progress before or after a simulation."""
    if watch.still <= most:
        return None
    return ProcessFailure(
        Status.TIMEOUT,
        "a step before or after the simulation, such as loading or a Python function in the "
        f"config, had not ended after {most:.3g} s and was stopped; check that function, or raise "
        "executor.stall",
    )


def too_large(child: int, limits: Limits) -> ProcessFailure | None:
    """Return the failure of a process that uses too much memory; None otherwise."""
    resident = resident_bytes(child)
    if resident <= limits.memory:
        return None
    return ProcessFailure(
        Status.OUT_OF_MEMORY,
        f"the simulation used {resident / 2**20:.0f} MB of memory and was stopped; if it needs "
        "that much, raise executor.memory",
    )


def how_it_ended(code: int | None) -> ProcessFailure:
    """Return the failure of a process that ended during a simulation."""
    if code is None or code == -signal.SIGKILL:
        message = "the process was killed from outside, perhaps because memory ran out"
        return ProcessFailure(Status.LOST_WORKER, message)
    if code < 0:
        name = _signal_name(-code)
        return ProcessFailure(Status.CRASH, f"the process crashed during this simulation ({name})")
    message = f"the process was ended by the FMU during this simulation (exit code {code})"
    return ProcessFailure(Status.CRASH, message)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


WATCH_SECONDS = 0.1
"""Seconds between two observations of the memory and progress of a running simulation."""
SELDOM_SECONDS = 1.0
"""Seconds between two observations if all limits are wide; an observation takes 0.1 ms."""
WIDE_LIMIT = 20.0
"""A limit is wide from this multiple of `SELDOM_SECONDS` on."""
MOST_TRIES, MOST_KILLS = 2, 10
"""Number of times that a simulation may fail, and may be killed by another program."""
CAREFUL = 500
"""Number of consecutive tasks without a failure before tasks are sent in batches again."""
MOST_INSTANCES = 900
"""Most instances of an FMU in one process; FMUs of some tools crash at about 1000."""


class LostError(Exception):
    """A process was killed by another program at its start; a new one may succeed."""


class SupervisedEvaluator:
    """An evaluator in a separate process.

    Parameters
    ----------
    model, experiments, name
        As for `Evaluator`.
    limits
        Limits at which a simulation is stopped.

    Raises
    ------
    ModelError
        If the FMU cannot be loaded, or the process ends during loading.
    """

    def __init__(
        self, model: Model, experiments: Sequence[Experiment], name: str, limits: Limits
    ) -> None:
        self._name, self._file, self._limits = name, model.name, limits
        self._reset = model.reset
        self._careful = 0
        self._known: set[int] = set()
        self._used = False
        self._base = 0
        self._stopped = False
        self._effects = False
        self._forks = ForkClient((model, tuple(experiments), name))
        self._child: tuple[int, Connection] | None = None
        try:
            self._begin_at_last()
        except BaseException:
            self.close()
            raise

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Answer every task of a batch, in the same order."""
        failed = 0
        together = self._reset in ("auto", "reset")
        if together and self._careful == 0 and self._is_known(batch):
            answered = self._ask(batch)
            if not isinstance(answered, ProcessFailure):
                return answered
            self._careful = CAREFUL
            failed = 0 if answered.from_outside else 1
        return [self._alone(task, failed) for task in batch.tasks()]

    def once(self, task: Task) -> Outcome:
        """Answer one task with a single attempt."""
        found = self._ask(TaskBatch.of([task]))
        return found[0] if isinstance(found, list) else self._failed(task, found)

    def free_instance(self) -> None:
        """End the process while it is idle; the next task starts a new one."""
        self._end(kill=True)

    def stop(self) -> None:
        """Stop the simulation from another thread; all later tasks fail."""
        self._stopped = True
        child = self._child
        if child is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child[0], signal.SIGKILL)

    def close(self) -> None:
        """End the processes. If another thread is waiting for an answer, call `stop` first."""
        self._stopped = True
        self._end(kill=True)
        self._forks.close()

    def _alone(self, task: Task, failed: int) -> Outcome:
        """Return the outcome of one task, which has failed `failed` times with its batch.

        It is repeated until it has failed in a new process, because leftovers of other simulations,
        such as leaked memory, must not make it fail.
        """
        self._careful = max(self._careful - 1, 0)
        lost = 0
        while True:
            alone = self._child is None or not self._used
            answered = self._ask(TaskBatch.of([task]))
            if not isinstance(answered, ProcessFailure):
                return answered[0]
            self._careful = CAREFUL
            lost += answered.from_outside
            failed += not answered.from_outside
            if (failed >= MOST_TRIES and alone) or lost >= MOST_KILLS:
                return self._failed(task, answered)

    def _failed(self, task: Task, failure: ProcessFailure) -> Outcome:
        return Outcome(task.id, failure.status, message=failure.message, worker=self._name)

    def _ask(self, batch: TaskBatch) -> list[Outcome] | ProcessFailure:
        """Make one attempt; return the outcomes, or the reason of the failure."""
        try:
            child, connection = self._child or self._begin()
        except ModelError as error:
            return ProcessFailure(Status.CRASH, str(error))
        except LostError as error:
            return ProcessFailure(Status.LOST_WORKER, str(error))
        self._effects |= bool(batch.effects)
        self._used = True
        try:
            connection.send(batch)
            failure = self._wait(child, connection)
            report: BatchReport | None = None if failure else connection.recv()
        except (EOFError, OSError):
            failure, report = None, None
        except BaseException:  # interrupted: nobody will read its answer any more
            self._end(kill=True)
            raise
        if report is None:
            code = self._end(kill=failure is not None)
            return failure or how_it_ended(code)
        outcomes = report.answers.outcomes()
        if report.spent:
            self._end(kill=True)
            if len(outcomes) > 1:  # tasks after the fatal error were not simulated
                return ProcessFailure(Status.LOST_WORKER, "another simulation ended its process")
        self._known.update(batch.experiments.tolist() if batch.want in USUAL else [])
        if self._reset == "process":
            self._end(kill=True)  # it has answered; its exit code does not matter
        elif self._has_grown(report):
            self._end(kill=True)  # freeing the FMU may hang, and its memory goes with the process
        return outcomes

    def _wait(self, child: int, connection: Connection) -> ProcessFailure | None:
        """Wait for an answer; return a failure if a limit is exceeded."""
        limits = self._limits
        wide = min(limits.seconds, limits.stall) >= WIDE_LIMIT * SELDOM_SECONDS
        pause = SELDOM_SECONDS if wide and limits.memory == float("inf") else WATCH_SECONDS
        if connection.poll(pause):  # most answers arrive before the first observation
            return None
        watch = ProgressWatch(child, self._forks.progress)
        while not connection.poll(pause):
            watch.look()
            failure = too_late(watch, limits) or too_large(child, limits)
            if failure is not None:
                return failure
        return None

    def _is_known(self, batch: TaskBatch) -> bool:
        """Return whether the tasks of a batch are sent together.

        The first simulations of an experiment may take minutes, so they are sent one by one. Then a
        failure affects only one of them.
        """
        return batch.want in USUAL and self._known.issuperset(batch.experiments.tolist())

    def _has_grown(self, report: BatchReport) -> bool:
        """Return whether to replace the process because of a memory leak or many instances."""
        self._base = self._base or report.resident
        grown = report.resident - self._base > self._limits.growth
        return grown or report.instances > MOST_INSTANCES

    def _begin_at_last(self) -> None:
        for left in reversed(range(MOST_KILLS)):
            try:
                self._begin()
                return
            except LostError as error:
                if not left:
                    raise ModelError(f"{self._file}: cannot be loaded: {error}") from error

    def _begin(self) -> tuple[int, Connection]:
        """Fork a process, and wait until it has loaded the FMU."""
        if self._stopped:
            raise ModelError(f"{self._file}: its worker was stopped")
        self._base, self._used = 0, False
        try:
            self._child = child, connection = self._forks.fork(effects=self._effects)
        except OSError as error:
            raise LostError(f"no process can be started ({error})") from error
        said: ModelError | None
        try:
            watch = ProgressWatch(child, self._forks.progress)
            while not connection.poll(WATCH_SECONDS):
                watch.look()
                if watch.still > LOAD_SECONDS:
                    self._end(kill=True)
                    raise ModelError(
                        f"{self._file}: must load within {LOAD_SECONDS:g} s, but does not; check "
                        "that it does not wait for a licence or a window"
                    )
            said = connection.recv()
        except KeyboardInterrupt:  # nobody will wait for this process any more
            self._end(kill=True)
            raise
        except (EOFError, OSError) as error:
            ended = how_it_ended(self._end(kill=False))
            if ended.from_outside:
                raise LostError(ended.message) from error
            raise ModelError(
                f"{self._file}: cannot be loaded: "
                f"{ended.message.replace('this simulation', 'loading')}; check that the FMU runs "
                "on this machine"
            ) from error
        if said is not None:
            self._end(kill=False)
            raise said
        return self._child

    def _end(self, *, kill: bool) -> int | None:
        """End the process; return its exit code, or minus the signal that ended it."""
        if self._child is None:
            return None
        child, connection = self._child
        self._child = None
        connection.close()
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        return self._forks.wait(child)
