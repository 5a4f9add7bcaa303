"""Simulations in a process of their own: one that crashes, hangs or leaks costs only itself.

A batch is sent to a forked process. If that dies or takes too long, each task of the batch is asked
again alone in a fresh one, and the one that fails even then is an outcome with the reason: no task
is tried a third time. For some time after, tasks go one by one, so that the next failure costs its
neighbours nothing.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path

from workers.child import Report, resident_bytes
from workers.errors import ModelError
from workers.messages import Experiment, Limits, Model, Outcome, Status, Task
from workers.wire import Batch
from workers.zygote import FORK

LOOK_SECONDS = 0.1
"""How often the memory of a running simulation is looked at."""
GRACE_SECONDS = 1.0
"""What a simulation may always take beyond what is usual."""
REMEMBERED = 31
"""Durations of each experiment, whose median is what is usual."""
CAREFUL = 500
"""Tasks in a row without a failure before they travel in batches again."""
MOST_INSTANCES = 900
"""Of an FMU in one process; some tools' FMUs die at about 1000."""
LOAD_SECONDS = 300.0


@dataclass(frozen=True)
class Failure:
    """Why a process did not answer."""

    status: Status
    message: str


class Guard:
    """An evaluator in a process of its own.

    Parameters
    ----------
    model, experiments, name
        As for `Evaluator`.
    limits
        When a simulation is ended from outside.

    Raises
    ------
    ModelError
        If the FMU cannot be loaded, or the process dies while it is.
    """

    def __init__(
        self, model: Model, experiments: Sequence[Experiment], name: str, limits: Limits
    ) -> None:
        self._name, self._file, self._limits = name, model.name, limits
        self._seconds: dict[int, deque[float]] = {}
        self._careful = 0
        self._base = 0
        self._stopped = False
        mine, theirs = socket.socketpair()
        with theirs:
            self._zygote = subprocess.Popen(
                [sys.executable, "-m", "workers.zygote", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": _import_path(), "OPENBLAS_NUM_THREADS": "1"},
            )
        self._orders = Connection(mine.detach())
        self._child: tuple[int, Connection] | None = None
        try:
            self._orders.send((model, tuple(experiments), name))
            self._begin()
        except BaseException:
            self.close()
            raise

    def evaluate(self, batch: Batch) -> list[Outcome]:
        """Answer every task of a batch, in its order."""
        if self._careful == 0 and self._is_usual(batch):
            answered = self._ask(batch)
            if not isinstance(answered, Failure):
                return answered
            self._careful = CAREFUL
            return [self._alone(task, None) for task in batch.tasks()]
        return [self._alone(task, self._ask(Batch.of([task]))) for task in batch.tasks()]

    def stop(self) -> None:
        """End what is simulated, from another thread; all that is asked from now on fails."""
        self._stopped = True
        child = self._child
        if child is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child[0], signal.SIGKILL)

    def close(self) -> None:
        """End the processes, whatever they are doing; only after `stop` if a thread waits."""
        self._stopped = True
        if not self._orders.closed:
            self._end(kill=True)
            self._orders.close()
            self._zygote.wait()

    def _alone(self, task: Task, first: list[Outcome] | Failure | None) -> Outcome:
        """The outcome of one task after a first attempt, or after its batch has failed."""
        self._careful = max(self._careful - 1, 0)
        if isinstance(first, list):
            return first[0]
        second = self._ask(Batch.of([task]))
        if isinstance(second, list):
            return second[0]
        self._careful = CAREFUL
        return Outcome(task.id, second.status, message=second.message, worker=self._name)

    def _ask(self, batch: Batch) -> list[Outcome] | Failure:
        """One attempt: the outcomes, or why there are none."""
        try:
            child, connection = self._child or self._begin()
        except ModelError as error:
            return Failure(Status.CRASH, str(error))
        begin = time.monotonic()
        try:
            connection.send(batch)
            failure = self._wait(child, connection, begin, self._limit(batch))
            report: Report | None = None if failure else connection.recv()
        except (EOFError, OSError):
            failure, report = None, None
        except BaseException:  # interrupted: what it would answer is nobody's any more
            self._end(kill=True)
            raise
        if report is None:
            code = self._end(kill=failure is not None)
            return failure or Failure(Status.CRASH, _how_it_ended(code))
        outcomes = report.answers.outcomes()
        self._learn(batch, outcomes)
        if self._has_grown(report):
            self._end(kill=False)
        return outcomes

    def _wait(
        self, child: int, connection: Connection, begin: float, limit: float
    ) -> Failure | None:
        """Wait for an answer; why not, if time or memory ran out."""
        while not connection.poll(min(LOOK_SECONDS, max(begin + limit - time.monotonic(), 0.0))):
            if time.monotonic() - begin >= limit:
                return Failure(
                    Status.TIMEOUT,
                    f"the simulation did not end within {limit:.3g} s and was stopped; raise "
                    "executor.timeout or executor.patience if it only needs longer",
                )
            resident = resident_bytes(child)
            if resident > self._limits.memory:
                return Failure(
                    Status.OUT_OF_MEMORY,
                    f"the simulation took {resident / 2**20:.0f} MB of memory and was stopped; "
                    "raise executor.memory if it needs that much",
                )
        return None

    def _limit(self, batch: Batch) -> float:
        """Seconds that a batch may take."""
        hard = self._limits.seconds * len(batch.ids)
        if self._limits.patience == 0.0 or not self._is_usual(batch):
            return hard
        usual = sum(statistics.median(self._seconds[e]) for e in batch.experiments.tolist())
        return min(hard, GRACE_SECONDS + self._limits.patience * usual)

    def _is_usual(self, batch: Batch) -> bool:
        """Whether it is known how long these simulations take; a first one goes alone."""
        return batch.want == "residuals" and all(
            e in self._seconds for e in batch.experiments.tolist()
        )

    def _learn(self, batch: Batch, outcomes: Sequence[Outcome]) -> None:
        if batch.want == "residuals":
            for experiment, outcome in zip(batch.experiments.tolist(), outcomes, strict=True):
                known = self._seconds.setdefault(experiment, deque(maxlen=REMEMBERED))
                known.append(outcome.seconds)

    def _has_grown(self, report: Report) -> bool:
        """Whether the process should be replaced before it fails: the FMU leaks."""
        self._base = self._base or report.resident
        grown = report.resident - self._base > self._limits.growth
        return grown or report.instances > MOST_INSTANCES

    def _begin(self) -> tuple[int, Connection]:
        """Fork a process and wait until it has loaded the FMU."""
        if self._stopped:
            raise ModelError(f"{self._file}: its worker was stopped")
        mine, theirs = socket.socketpair()
        self._base = 0
        try:
            with theirs:
                self._orders.send(FORK)
                reduction.send_handle(self._orders, theirs.fileno(), self._zygote.pid)
                child = self._orders.recv()
        except (EOFError, OSError) as error:
            mine.close()
            raise ModelError(f"{self._file}: no process can be started for it ({error})") from error
        connection = Connection(mine.detach())
        self._child = child, connection
        said: ModelError | None
        try:
            if not connection.poll(LOAD_SECONDS):
                self._end(kill=True)
                raise ModelError(
                    f"{self._file}: must load within {LOAD_SECONDS:g} s but does not; check that "
                    "it does not wait for a licence or a window"
                )
            said = connection.recv()
        except (EOFError, OSError) as error:
            code = self._end(kill=False)
            raise ModelError(
                f"{self._file}: must load but {_how_it_ended(code)} while it did; check that it "
                "runs on this machine"
            ) from error
        if said is not None:
            self._end(kill=False)
            raise said
        return self._child

    def _end(self, *, kill: bool) -> int | None:
        """End the process; its exit code, or minus the signal that ended it."""
        if self._child is None:
            return None
        child, connection = self._child
        self._child = None
        connection.close()
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        try:
            self._orders.send(child)
            code: int = self._orders.recv()
        except (EOFError, OSError):
            return None
        return code


def _how_it_ended(code: int | None) -> str:
    """A sentence's end: what became of a process."""
    if code is None:
        return "the process was lost during this simulation"
    if code == -signal.SIGKILL:
        return (
            "the process was killed from outside during this simulation, perhaps because memory "
            "ran out"
        )
    if code < 0:
        return f"the process crashed during this simulation ({_signal_name(-code)})"
    return f"the process was ended by the FMU during this simulation (exit code {code})"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _import_path() -> str:
    """Where this package stands, for the process to find it too."""
    own = str(Path(__file__).parent.parent)
    return os.pathsep.join([own, *filter(None, [os.environ.get("PYTHONPATH")])])
