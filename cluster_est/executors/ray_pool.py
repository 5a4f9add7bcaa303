"""Simulations in Ray actors, one for each core, on this machine or a cluster.

Two batches are in flight for each actor, so that it never waits for the coordinator. Actors may
come and go: what a lost one had is asked again elsewhere, and what takes much longer than usual is
asked twice where a worker is idle. The first answer counts, which changes nothing: both are the
same bits, and who of the two fails has tried in a fresh process. An FMU that crashes or hangs takes
no actor with it (see `workers.process.supervisor`), so a task is given up only after many lost
workers.

Where the number of the FMU's instances is limited, each actor has a seat. On one machine a seat is
a lock that its process holds (`workers.fmu.seats`). No lock reaches from one machine to another, so
an actor that takes the place of another is started on the node where that one was: there it waits
until the other one's process is gone. If that node is gone, so is everything on it, and Ray may
choose any.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from cluster_est.errors import ExecutorError
from cluster_est.executors.backlog import TaskBacklog
from cluster_est.executors.executor import WorkerPool
from cluster_est.executors.ray_cluster import (
    connect,
    cores,
    disconnect,
    folder_of_workers,
    why_not_started,
)
from workers.actor import FmuActor
from workers.messages import Experiment, Limits, Model, Outcome, Seats, Status, Task
from workers.wire import OutcomeColumns, TaskBatch

_nodes: dict[tuple[str, int], str] = {}
"""The node where each seat was taken last, as long as this program lives: pools follow pools."""


class ActorSeats:
    """The seats of a pool, and which actor has which.

    Parameters
    ----------
    seats
        Of the pool; None where any number of instances may exist.
    """

    def __init__(self, seats: Seats | None) -> None:
        self._seats = seats
        self._free = [] if seats is None else list(range(len(seats.numbers)))
        self._of: dict[str, int] = {}
        self._asked: dict[str, Any] = {}

    def take(self, name: str) -> int:
        """Give a new actor a seat; return its number among the pool's workers."""
        if self._seats is None:
            return 0
        self._of[name] = worker = self._free.pop(0)
        return worker

    def placed(self, worker: int) -> dict[str, Any]:
        """Return the options that an actor with this seat is started with."""
        node = None if self._seats is None else _nodes.get(self._key(worker))
        if node is None:
            return {}
        return {"scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=True)}

    def ask_node(self, name: str, actor: Any) -> None:
        """Ask an actor where it is, before it loads the FMU."""
        if self._seats is not None:
            self._asked[name] = actor.node.remote()

    def leave(self, name: str) -> None:
        """Note that an actor is lost: its seat is for the next one, on the same node."""
        if self._seats is None:
            return
        self._note_node(name)
        self._free.append(self._of.pop(name))
        self._free.sort()

    def close(self) -> None:
        """Note that all actors have ended."""
        for name in list(self._of):
            self.leave(name)

    def first(self, workers: int) -> list[str]:
        """Return the actors that have the first seats."""
        return [name for name, worker in self._of.items() if worker < workers]

    def _note_node(self, name: str) -> None:
        """Remember where an actor was; one that never said so has not loaded anything."""
        reference = self._asked.pop(name)
        ready, _ = ray.wait([reference], timeout=0)
        if not ready:
            return
        try:
            node: str = ray.get(reference)
        except RayError:
            return
        _nodes[self._key(self._of[name])] = node

    def _key(self, worker: int) -> tuple[str, int]:
        assert self._seats is not None
        return self._seats.program, self._seats.numbers[worker]


IN_FLIGHT = 2
SECONDS_OF_FEW_TASKS_ON_RAY = 0.9
"""Seconds that a few tasks which travel together may take: more than elsewhere, for a message to an
actor costs milliseconds of its core and of the coordinator's."""
STRAGGLER_POLL_SECONDS = 0.5
"""How often stragglers are looked for while nothing comes back."""
CLUSTER_SECONDS = 5.0
"""How often the size of the cluster is looked at."""
LATE, GRACE_SECONDS = 3.0, 0.5
"""A batch is late after so many times what is usual, and this."""
LOSSES_BEFORE_ALONE, LOSSES_BEFORE_GIVEN_UP = 3, 6
"""Lost workers after which a task is sent alone, and after which it is not sent any more."""
START_SECONDS, SECOND_SECONDS = 10.0, 40.0
"""How long all workers are waited for, once there is one, and the second if it must be asked."""
FAILED_FIRST_STARTS, FAILED_STARTS = 3, 50
"""Workers in a row that may be lost while they start: the first ones, and later ones."""


class _BatchInFlight(NamedTuple):
    """A batch on an actor. If `alone`, nothing else is in flight there and it has one task.

    `submission` counts how often tasks had been submitted when it was sent.
    """

    actor: str
    batch: TaskBatch
    alone: bool
    begin: float
    submission: int


class RayPool(WorkerPool):
    """A pool of Ray actors. For slow or dangerous FMUs, many cores, and clusters."""

    name: ClassVar[str] = "ray"
    in_process: ClassVar[bool] = False
    on_cluster: ClassVar[bool] = True

    def __init__(
        self,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        limits: Limits,
        *,
        owns_ray: bool,
    ) -> None:
        self._fixed, self._model = workers, model
        self._seats = ActorSeats(model.seats)
        self._owns_ray = owns_ray
        own = uuid.uuid4().hex[:12]
        folder = folder_of_workers()
        self._installation = ray.put(model), ray.put(experiments), limits, own, folder
        self._backlog = TaskBacklog(IN_FLIGHT * self.workers, SECONDS_OF_FEW_TASKS_ON_RAY)
        self._starting: dict[Any, tuple[str, Any]] = {}
        self._actors: dict[str, Any] = {}
        self._flying: dict[Any, _BatchInFlight] = {}
        self._suspects: deque[Task] = deque()
        self._open: dict[int, int] = {}  # by id, the submission a task came with
        self._twice: set[int] = set()
        self._lost: Counter[int] = Counter()
        self._started = self._failed = self._submissions = 0
        self._ready = False
        self._looked = time.monotonic()
        self._start_missing()

    @classmethod
    def join(cls, workers: int | None, address: str | None) -> Callable[[], None]:
        joined_here = connect(workers, address)
        return disconnect if joined_here else lambda: None

    @classmethod
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
        limits: Limits | None = None,
    ) -> Self:
        owns_ray = connect(workers, address)
        pool = cls(model, experiments, workers, limits or Limits(), owns_ray=owns_ray)
        try:
            pool._wait_for_workers(pool.workers, START_SECONDS)
        except BaseException:
            pool.close()
            raise
        return pool

    @property
    def workers(self) -> int:  # type: ignore[override]
        """As many as wanted, or as there are cores at the moment; as many as may have the FMU."""
        return self._model.at_most(self._fixed or cores())

    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        if last:
            self._wait_for_workers(2, SECOND_SECONDS)
        for _ in range(LOSSES_BEFORE_ALONE):
            name, actor = list(self._actors.items())[-1 if last else 0]
            asked = [actor.once.remote(TaskBatch.of([task])) for task in tasks]
            try:
                return [outcome for answers in ray.get(asked) for outcome in answers.outcomes()]
            except RayError:  # lost: what is decided by its answers must not depend on that
                self._replace(name)
                self._wait_for_workers(self.workers, START_SECONDS)
        return []

    def submit(self, tasks: Sequence[Task]) -> None:
        self._submissions += 1
        self._open |= {task.id: self._submissions for task in tasks}
        self._backlog.add(tasks)
        self._fill()

    def completed(self) -> list[Outcome]:
        outcomes: list[Outcome] = []
        if not self._open and self._flying:
            self._receive(0.0)  # the other answers to what was asked twice
        while self._open and not outcomes:
            outcomes += self._receive(STRAGGLER_POLL_SECONDS)
            self._look()
            self._fill()
        return outcomes

    def _receive(self, seconds: float) -> list[Outcome]:
        """Wait at most so long until something comes back; outcomes that nobody else has given."""
        outcomes: list[Outcome] = []
        waiting = [*self._flying, *self._starting]
        done, _ = ray.wait(waiting, num_returns=1, timeout=seconds)
        also, _ = ray.wait(waiting, num_returns=len(waiting), timeout=0)
        for reference in dict.fromkeys([*done, *also]):
            if reference in self._starting:
                self._join(reference)
            else:
                outcomes += self._collect(reference)
        return outcomes

    def cancel(self, tasks: Collection[int]) -> list[int]:
        removed = self._backlog.remove(tasks)
        for task in removed:
            self._open.pop(task, None)
        return removed

    @property
    def busy(self) -> int:
        return len({flight.actor for flight in self._flying.values()})

    def free_instances(self, workers: int) -> None:
        for _ in range(LOSSES_BEFORE_GIVEN_UP):
            names = self._seats.first(workers)
            if sum(self._frees_instance(name) for name in names) == len(names):
                return
        raise ExecutorError(
            f"executor.instances: a worker must free its instance of {self._model.name}, but "
            f"{LOSSES_BEFORE_GIVEN_UP} replacements of the worker were lost meanwhile; check the "
            "nodes of the cluster"
        )

    def _frees_instance(self, name: str) -> bool:
        """Have an actor let its FMU go; False if it was lost, and another one has its seat."""
        for reference in [r for r, (starting, _) in self._starting.items() if starting == name]:
            self._join(reference)
        if name not in self._actors:
            return False
        try:
            ray.get(self._actors[name].free_instance.remote())
        except RayError:
            self._replace(name)
            return False
        return True

    def close(self) -> None:
        self._seats.close()
        for actor in [*self._actors.values(), *(actor for _, actor in self._starting.values())]:
            ray.kill(actor)
        for kept in (self._actors, self._starting, self._flying, self._suspects, self._open):
            kept.clear()
        self._backlog.clear()
        if self._owns_ray:
            self._owns_ray = False
            disconnect()

    def _wait_for_workers(self, wanted: int, seconds: float) -> None:
        """Wait for one worker however long it takes, and so long until there are enough."""
        begin = time.monotonic()
        while self._starting and len(self._actors) < wanted:
            left = max(begin + seconds - time.monotonic(), 0.0) if self._actors else None
            done, _ = ray.wait(list(self._starting), num_returns=1, timeout=left)
            if not done:
                return
            self._join(done[0])

    def _start_missing(self) -> None:
        for _ in range(self.workers - len(self._actors) - len(self._starting)):
            name = f"ray-{self._started}"
            self._started += 1
            worker = self._seats.take(name)
            how = FmuActor.options(**self._seats.placed(worker))  # type: ignore[attr-defined]
            actor = how.remote(*self._installation, name)
            self._seats.ask_node(name, actor)
            self._starting[actor.ready.remote(worker)] = name, actor

    def _join(self, reference: Any) -> None:
        """A worker is ready, or has failed to start."""
        name, actor = self._starting.pop(reference)
        try:
            ray.get(reference)
        except RayError as error:
            self._failed += 1
            self._seats.leave(name)
            most = FAILED_STARTS if self._ready else FAILED_FIRST_STARTS
            if isinstance(error, RayTaskError) or self._failed >= most:
                raise why_not_started(error) from error
            self._start_missing()
            return
        self._failed, self._ready = 0, True
        self._actors[name] = actor

    def _look(self) -> None:
        """Give what is late to idle workers too; follow a cluster that grows."""
        now = time.monotonic()
        if not (self._backlog or self._suspects):
            self._duplicate(now)
        if now - self._looked > CLUSTER_SECONDS:
            self._looked = now
            self._start_missing()

    def _duplicate(self, now: float) -> None:
        load = Counter(flight.actor for flight in self._flying.values())
        idle = [name for name in self._actors if not load[name]]
        for flight in sorted(self._flying.values(), key=lambda flight: flight.begin):
            ids = self._unanswered(flight) - self._twice
            usual = self._backlog.expected(flight.batch)
            if not idle:
                return
            if ids and now - flight.begin > GRACE_SECONDS + LATE * usual:
                self._twice |= ids
                again = TaskBatch.of([task for task in flight.batch.tasks() if task.id in ids])
                self._send(idle.pop(), again, alone=flight.alone)

    def _fill(self) -> None:
        """Give idle actors one suspect each, and all others their share of what waits."""
        load = Counter(flight.actor for flight in self._flying.values())
        for name in self._actors:
            if self._suspects and not load[name]:
                self._send(name, TaskBatch.of([self._suspects.popleft()]), alone=True)
                load[name] += 1
        reserved = {flight.actor for flight in self._flying.values() if flight.alone}
        for level in range(IN_FLIGHT):
            for name in self._actors:
                if self._backlog and load[name] <= level and name not in reserved:
                    self._send(name, self._backlog.take(), alone=False)
                    load[name] += 1

    def _send(self, name: str, batch: TaskBatch, *, alone: bool) -> None:
        reference = self._actors[name].evaluate.remote(batch)
        begin, submission = time.monotonic(), self._submissions
        self._flying[reference] = _BatchInFlight(name, batch, alone, begin, submission)

    def _unanswered(self, flight: _BatchInFlight) -> set[int]:
        """Which tasks of a batch nobody has answered.

        An id that was answered elsewhere and submitted again since stands for another task.
        """
        submitted = ((task, self._open.get(task)) for task in flight.batch.ids.tolist())
        return {task for task, at in submitted if at is not None and at <= flight.submission}

    def _collect(self, reference: Any) -> list[Outcome]:
        """Outcomes that nobody else has given yet."""
        flight = self._flying.pop(reference)
        try:
            answers: OutcomeColumns = ray.get(reference)
        except RayTaskError as error:
            line = str(error).strip().splitlines()[-1]
            raise ExecutorError(f"executor: a worker failed unexpectedly ({line})") from error
        except RayError as error:
            return self._recover(flight, error)
        outcomes = answers.outcomes()
        self._backlog.learn(flight.batch, outcomes)
        return self._first(outcomes, self._unanswered(flight))

    def _first(self, outcomes: list[Outcome], unanswered: set[int]) -> list[Outcome]:
        first = [outcome for outcome in outcomes if outcome.task in unanswered]
        for outcome in first:
            del self._open[outcome.task]
            self._twice.discard(outcome.task)
            if self._lost.pop(outcome.task, 0):
                self._forget(outcome.task)
        return first

    def _forget(self, answered: int) -> None:
        """Do not ask again what was lost on one worker and has been answered by another."""
        self._backlog.remove([answered])
        self._suspects = deque(task for task in self._suspects if task.id != answered)

    def _recover(self, flight: _BatchInFlight, error: RayError) -> list[Outcome]:
        """Replace a lost worker and ask again for what it had; outcomes of what is given up."""
        self._replace(flight.actor)
        given_up = []
        unanswered = self._unanswered(flight)
        for task in flight.batch.tasks():
            if task.id not in unanswered:
                continue
            self._twice.discard(task.id)
            self._lost[task.id] += 1
            if self._lost[task.id] >= LOSSES_BEFORE_GIVEN_UP:
                given_up.append(_lost(task, error))
            elif self._lost[task.id] >= LOSSES_BEFORE_ALONE:
                self._suspects.append(task)
            else:
                self._backlog.add_first(task)
        return self._first(given_up, unanswered)

    def _replace(self, name: str) -> None:
        """Start another actor instead of a dead one, which is killed in case it only seems dead."""
        actor = self._actors.pop(name, None)
        if actor is not None:
            ray.kill(actor)
            self._seats.leave(name)
            self._start_missing()


def _lost(task: Task, error: RayError) -> Outcome:
    line = (str(error).splitlines() or ["the process ended"])[0]
    message = (
        f"{LOSSES_BEFORE_GIVEN_UP} workers were lost during this simulation; the last one said: "
        f"{line}"
    )
    return Outcome(task.id, Status.LOST_WORKER, message=message)
