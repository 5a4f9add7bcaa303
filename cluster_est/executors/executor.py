"""The interface of an executor, which runs tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import ClassVar, Self

from cluster_est.plug_in import check_class_attributes
from workers.messages import Experiment, Limits, Model, Outcome, ResetPolicy, Task, Want


class Executor(ABC):
    """An executor takes tasks and returns one outcome for each task, in any order.

    It is a context manager. It does not raise an error if a simulation fails. The bits of an
    outcome must not depend on the place of the simulation or on other tasks.
    """

    workers: int
    """Number of simultaneous simulations."""

    reset: ResetPolicy = "auto"
    """The reset policy, after it has been decided."""

    @abstractmethod
    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue tasks and return at once.

        An id may be used again after its task has an outcome or was cancelled. At that time, a
        second worker may still simulate the old task.

        Tasks may have different wanted results and effects. The tasks of a batch may not:
        `executors.backlog.TaskBacklog` creates such batches.
        """

    @abstractmethod
    def completed(self) -> list[Outcome]:
        """Wait for at least one outcome; return all new outcomes, or none if no task is queued.

        An interrupt (Ctrl-C) must be possible while it waits. So slow simulations must run in
        another thread or process.
        """

    @abstractmethod
    def cancel(self, tasks: Collection[int]) -> list[int]:
        """Cancel tasks, by id, that have not begun; return the cancelled ids."""

    @property
    @abstractmethod
    def busy(self) -> int:
        """Number of busy workers.

        If a task was sent to two workers, the slower worker counts too until it is done.
        """

    def free_instances(self, workers: int) -> None:  # noqa: B027 (an executor may have no instances)
        """Free the FMU instances of the first workers until their next task.

        Call it before other code creates instances, if their number is limited. No task may be
        queued. After `close` it does nothing.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the workers and discard queued tasks. It may be called twice.

        Afterwards there are no outcomes and no busy workers.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class WorkerPool(Executor):
    """An executor that a config can select, with workers that have the model."""

    name: ClassVar[str]
    """Name of the executor in a config."""

    in_process: ClassVar[bool]
    """Whether simulations run in this process, so that a crash of the FMU ends it."""

    on_cluster: ClassVar[bool] = False
    """Whether all pools of a process run on one cluster, which is joined once; see `join`."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @classmethod
    def join(cls, workers: int | None, address: str | None) -> Callable[[], None]:
        """Join the cluster for several pools; return the function that leaves it.

        If this was not called, `open` joins the cluster. Call it only if `on_cluster`.

        Raises
        ------
        ExecutorError
            If the cluster cannot be joined.
        """
        raise NotImplementedError

    @classmethod
    @abstractmethod
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
        limits: Limits | None = None,
    ) -> Self:
        """Start workers and install the model and its experiments on each.

        Parameters
        ----------
        model, experiments
            The model and the experiments of the tasks.
        workers
            Number of workers; None for the executor's default. At most `model.at_most(workers)` are
            started, and worker i has `model.of_worker(i)`.
        address
            Address of the cluster, for executors on clusters.
        limits
            Limits after which a simulation is ended from outside, for executors that support this.

        Raises
        ------
        ModelError
            If a worker cannot load the FMU.
        ExecutorError
            If no worker can be started.
        """

    first: Outcome | None = None
    """Outcome of the repeatability test before the first recorded simulation, if there is one."""
    first_task: Task | None = None
    """The simulation with the outcome `first`: a later run on these workers may start elsewhere."""
    first_at: float = 0.0
    """Time of the outcome `first`, in seconds of `time.monotonic`."""

    @abstractmethod
    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        """Run tasks one after the other on one worker, always the same; return their outcomes.

        No other task may be queued. Each task runs once, even if it crashes. The ids may be used
        again. The result is empty if the worker was lost.

        Parameters
        ----------
        tasks
            The tasks to run.
        last
            Whether to use the last worker instead of the first.
        """


class OutcomeSource(ABC):
    """A source of known outcomes, such as the log of an interrupted run.

    Outcomes are numbered in the order of their arrival. Each is used once.
    """

    remaining: int
    """Number of outcomes that are not taken yet."""

    @abstractmethod
    def take(self, questions: Sequence[tuple[str, Want]]) -> list[int | None]:
        """Return the row of the first outcome not yet taken, for each simulation key and want."""

    @abstractmethod
    def is_whole(self, row: int) -> bool:
        """Return whether an outcome is complete; otherwise it must be simulated again."""

    @abstractmethod
    def outcome(self, row: int, task: int) -> Outcome:
        """Return an outcome, with the id of a task."""

    @abstractmethod
    def compare(self, row: int, outcome: Outcome) -> None:
        """Compare a repeated outcome with the known parts of the first outcome."""

    @abstractmethod
    def note_answered(self, task: int) -> None:
        """Record that this source answered a task, so that it is not logged again."""
