"""Simulations in Ray actors, one for each core, on this machine or a cluster.

Two batches are in flight for each actor, so that it never waits for the coordinator. An actor that
dies is replaced, and each task that it had is asked again with nothing else in flight on the same
actor: the one that kills its actor even then becomes an outcome with the status "crash".
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections import Counter, deque
from collections.abc import Collection, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import ray
from ray.exceptions import RayActorError, RayError, RayTaskError

from cluster_est.errors import ExecutorError, ModelError
from cluster_est.executors.backlog import Backlog
from cluster_est.executors.base import Executor
from workers.actor import Worker
from workers.messages import Experiment, Model, Outcome, Status, Task
from workers.wire import Answers, Batch

IN_FLIGHT = 2


class _Flight(NamedTuple):
    """A batch on an actor. If `alone`, nothing else is in flight there and it has one task."""

    actor: str
    batch: Batch
    alone: bool


class RayPool(Executor):
    """A pool of Ray actors. For slow or dangerous FMUs, many cores, and clusters."""

    name: ClassVar[str] = "ray"

    def __init__(
        self,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int,
        *,
        owns_ray: bool,
    ) -> None:
        self.workers = workers
        self._owns_ray = owns_ray
        self._model = ray.put(model)
        self._experiments = ray.put(experiments)
        self._backlog = Backlog(shares=2 * IN_FLIGHT * workers)
        self._actors: dict[str, Any] = {}
        self._flying: dict[Any, _Flight] = {}
        self._suspects: deque[Task] = deque()
        self._started = 0
        for _ in range(workers):
            self._start_actor()

    @classmethod
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
    ) -> Self:
        owns_ray = not ray.is_initialized()
        if owns_ray:
            _connect(workers, address)
        count = workers or int(ray.cluster_resources().get("CPU", 1))
        pool = cls(model, experiments, count, owns_ray=owns_ray)
        try:
            ray.get([actor.ready.remote() for actor in pool._actors.values()])
        except (RayError, ModelError) as error:
            pool.close()
            raise _why_not_started(error) from error
        return pool

    def submit(self, tasks: Sequence[Task]) -> None:
        self._backlog.add(tasks)
        self._fill()

    def completed(self) -> list[Outcome]:
        outcomes: list[Outcome] = []
        while self._flying and not outcomes:
            done, _ = ray.wait(list(self._flying), num_returns=1)
            also, _ = ray.wait(list(self._flying), num_returns=len(self._flying), timeout=0)
            for reference in dict.fromkeys([*done, *also]):
                outcomes += self._collect(reference)
            self._fill()
        return outcomes

    def cancel(self, tasks: Collection[int]) -> list[int]:
        return self._backlog.remove(tasks)

    @property
    def busy(self) -> int:
        return len({flight.actor for flight in self._flying.values()})

    def close(self) -> None:
        for actor in self._actors.values():
            ray.kill(actor)
        self._actors.clear()
        self._flying.clear()
        self._suspects.clear()
        self._backlog.clear()
        if self._owns_ray:
            self._owns_ray = False
            ray.shutdown()

    def _start_actor(self) -> None:
        name = f"ray-{self._started}"
        self._started += 1
        self._actors[name] = Worker.remote(  # type: ignore[attr-defined]
            self._model, self._experiments, name
        )

    def _fill(self) -> None:
        """Give idle actors one suspect each, and all others their share of what waits."""
        load = Counter(flight.actor for flight in self._flying.values())
        for name in self._actors:
            if self._suspects and not load[name]:
                self._send(name, Batch.of([self._suspects.popleft()]), alone=True)
        reserved = {flight.actor for flight in self._flying.values() if flight.alone}
        for level in range(IN_FLIGHT):
            for name in self._actors:
                if self._backlog and load[name] <= level and name not in reserved:
                    self._send(name, self._backlog.take(), alone=False)
                    load[name] += 1

    def _send(self, name: str, batch: Batch, *, alone: bool) -> None:
        reference = self._actors[name].evaluate.remote(batch)
        self._flying[reference] = _Flight(name, batch, alone)

    def _collect(self, reference: Any) -> list[Outcome]:
        flight = self._flying.pop(reference)
        try:
            answers: Answers = ray.get(reference)
        except RayActorError as error:
            self._replace(flight.actor)
            if flight.alone:
                return [_crash(flight.batch, error)]
            self._suspects += flight.batch.tasks()
            return []
        outcomes = answers.outcomes()
        self._backlog.learn(flight.batch, outcomes)
        return outcomes

    def _replace(self, name: str) -> None:
        """Start another actor instead of a dead one, which is killed in case it only seems dead."""
        actor = self._actors.pop(name, None)
        if actor is not None:
            ray.kill(actor)
            self._start_actor()


def _crash(batch: Batch, error: RayActorError) -> Outcome:
    line = (str(error).splitlines() or ["the process ended"])[0]
    message = f"the worker process died during this simulation ({line})"
    return Outcome(int(batch.ids[0]), Status.CRASH, message=message)


def _connect(workers: int | None, address: str | None) -> None:
    """Join a cluster, or start Ray on this machine alone."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    local = address in (None, "", "local")
    try:
        ray.init(
            address="local" if local else address,
            num_cpus=workers if local else None,
            include_dashboard=False if local else None,
            logging_level=logging.ERROR,
            log_to_driver=False,
        )
    except (ConnectionError, RuntimeError, ValueError, RayError) as error:
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise ExecutorError(
            f"executor.address: no Ray cluster answers at {address!r} ({line}); start one, or "
            "remove the key to use this machine"
        ) from error


def _why_not_started(error: Exception) -> Exception:
    """The model's own error where there is one, else a sentence around Ray's."""
    cause: BaseException | None = error
    with contextlib.suppress(AttributeError):
        cause = error.cause if isinstance(error, RayTaskError) else error
    if isinstance(cause, ModelError):
        return ModelError(str(cause))
    text = str(error)
    marker = "ModelError: "
    if marker in text:
        return ModelError(text.split(marker, 1)[1].splitlines()[0])
    line = (text.splitlines() or [type(error).__name__])[0]
    return ExecutorError(f"executor: the workers did not start ({line})")
