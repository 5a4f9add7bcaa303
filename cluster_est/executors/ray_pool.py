"""Simulations in Ray actors, one for each core, on this machine or a cluster.

Each actor has two batches in flight, so that it never waits for the coordinator. The tasks of a
lost actor are sent to other actors. A batch that takes much longer than usual is also sent to an
idle actor. The first answer is used; both answers have the same bits, and a failed simulation was
repeated in a fresh process. An FMU that crashes or hangs does not end its actor (see
`workers.process.supervisor`). So a task is given up only after many lost workers.

If the number of the FMU's instances is limited, each actor has a seat. On one machine a seat is a
lock that its process holds (`workers.fmu.seats`). Locks do not work across machines. So the
replacement of an actor is started on the node of that actor, and waits there until the old process
has ended. If the node is gone, so are its processes, and Ray may choose any node.
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
"""Last node of each seat, for later pools of this program."""


class ActorSeats:
    """The seats of a pool and their actors.

    Parameters
    ----------
    seats
        Seats of the pool; None if any number of instances may exist.
    """

    def __init__(self, seats: Seats | None) -> None:
        self._seats = seats
        self._free = [] if seats is None else list(range(len(seats.numbers)))
        self._of: dict[str, int] = {}
        self._asked: dict[str, Any] = {}

    def take(self, name: str) -> int:
        """Assign a seat to a new actor; return the number of the seat in the pool."""
        if self._seats is None:
            return 0
        self._of[name] = worker = self._free.pop(0)
        return worker

    def placed(self, worker: int) -> dict[str, Any]:
        """Return the start options of an actor with this seat."""
        node = None if self._seats is None else _nodes.get(self._key(worker))
        if node is None:
            return {}
        return {"scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=True)}

    def ask_node(self, name: str, actor: Any) -> None:
        """Request the node of an actor, before it loads the FMU."""
        if self._seats is not None:
            self._asked[name] = actor.node.remote()

    def leave(self, name: str) -> None:
        """Free the seat of a lost actor for the next actor, on the same node."""
        if self._seats is None:
            return
        self._note_node(name)
        self._free.append(self._of.pop(name))
        self._free.sort()

    def close(self) -> None:
        """Free all seats, after all actors have ended."""
        for name in list(self._of):
            self.leave(name)

    def first(self, workers: int) -> list[str]:
        """Return the names of the actors with the first seats."""
        return [name for name, worker in self._of.items() if worker < workers]

    def _note_node(self, name: str) -> None:
        """Record the node of an actor; an actor without an answer has not loaded the FMU."""
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
"""Largest duration of a batch of a few tasks.

It is longer than in other executors, because a message to an actor costs milliseconds of its core
and of the coordinator's."""
STRAGGLER_POLL_SECONDS = 0.5
"""Interval of the search for late batches while no outcomes arrive."""
CLUSTER_SECONDS = 5.0
"""Interval of the checks of the cluster's size."""
LATE, GRACE_SECONDS = 3.0, 0.5
"""A batch is late after its expected duration times `LATE`, plus `GRACE_SECONDS`."""
LOSSES_BEFORE_ALONE, LOSSES_BEFORE_GIVEN_UP = 3, 6
"""Number of lost workers after which a task is sent alone, and after which it is given up."""
START_SECONDS, SECOND_SECONDS = 10.0, 40.0
"""Waiting time for all workers after the first is ready, and for a required second worker."""
FAILED_FIRST_STARTS, FAILED_STARTS = 3, 50
"""Number of workers lost in a row at their start that is an error: first workers, later ones."""


class _BatchInFlight(NamedTuple):
    """A batch on an actor. If `alone`, it has one task and is the actor's only batch.

    `submission` is the number of calls of `submit` before the batch was sent.
    """

    actor: str
    batch: TaskBatch
    alone: bool
    begin: float
    submission: int


class RayPool(WorkerPool):
    """A pool of Ray actors, for slow or unreliable FMUs, many cores, and clusters."""

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
        self._open: dict[int, int] = {}  # submission of each task without an outcome, by id
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
        """Requested number, or the current number of cores; limited by the FMU's instances."""
        return self._model.at_most(self._fixed or cores())

    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        if last:
            self._wait_for_workers(2, SECOND_SECONDS)
        for _ in range(LOSSES_BEFORE_ALONE):
            name, actor = list(self._actors.items())[-1 if last else 0]
            asked = [actor.once.remote(TaskBatch.of([task])) for task in tasks]
            try:
                return [outcome for answers in ray.get(asked) for outcome in answers.outcomes()]
            except RayError:  # the actor is lost: repeat, so that decisions do not depend on this
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
            self._receive(0.0)  # second answers to tasks that were sent twice
        while self._open and not outcomes:
            outcomes += self._receive(STRAGGLER_POLL_SECONDS)
            self._look()
            self._fill()
        return outcomes

    def _receive(self, seconds: float) -> list[Outcome]:
        """Wait at most `seconds` for answers; return outcomes of tasks without an outcome yet."""
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
        """Free the instance of an actor; return False if the actor was lost and replaced."""
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
        """Wait for one worker without limit, and at most `seconds` for the wanted number."""
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
        """Register a worker that is ready, or process its failure to start."""
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
        """Send late batches to idle workers too, and start workers on new cores."""
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
        """Send one suspect task to each idle actor, and batches to the other actors."""
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
        """Return the ids of a batch's tasks without an outcome.

        An id that was submitted again after the batch was sent belongs to another task.
        """
        submitted = ((task, self._open.get(task)) for task in flight.batch.ids.tolist())
        return {task for task, at in submitted if at is not None and at <= flight.submission}

    def _collect(self, reference: Any) -> list[Outcome]:
        """Return the outcomes of a finished batch for tasks without an outcome yet."""
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
        """Remove a task from the queues: one worker lost it, but another has answered it."""
        self._backlog.remove([answered])
        self._suspects = deque(task for task in self._suspects if task.id != answered)

    def _recover(self, flight: _BatchInFlight, error: RayError) -> list[Outcome]:
        """Replace a lost worker and queue its tasks again; return outcomes of given-up tasks."""
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
        """Start another actor in place of a lost one; kill the lost actor in case it still runs."""
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
