"""The contract of an executor: where tasks run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import ClassVar, Self

from cluster_est.plug_in import check_class_attributes
from workers.messages import Experiment, Limits, Model, Outcome, ResetPolicy, Task, Want


class Executor(ABC):
    """Takes tasks and gives back one outcome for each, in any order.

    Used as a context manager. It never raises for a simulation that fails, and it changes no bit of
    a result: what a task answers must not depend on where and with which others it ran.
    """

    workers: int
    """How many simulations run at the same time."""

    reset: ResetPolicy = "auto"
    """What every simulation begins with, once that has been decided."""

    @abstractmethod
    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue tasks. Returns at once.

        An id may be used again once its task was answered or taken back, even while a worker that
        was given the former task too has not answered yet.

        Tasks may differ in what they want and in their effects. A batch for a worker may not:
        `executors.backlog.TaskBacklog` cuts such batches.
        """

    @abstractmethod
    def completed(self) -> list[Outcome]:
        """Wait until at least one task is done; give back all that are. Empty if none is queued.

        An interrupt (Ctrl-C) must come through while it waits, so that slow simulations belong into
        another thread or process.
        """

    @abstractmethod
    def cancel(self, tasks: Collection[int]) -> list[int]:
        """Take back tasks, by id, that have not begun; give back which. The others go on."""

    @property
    @abstractmethod
    def busy(self) -> int:
        """Number of workers that have something to do.

        Where a task was given to two, the slower one counts too until it has answered.
        """

    def free_instances(self, workers: int) -> None:  # noqa: B027 (what holds no instances has none to let go)
        """Have the first workers let their instances of the FMU go until they are asked again.

        Where the number of instances is limited, somebody else is about to make some. Nothing is
        queued then. After `close` it does nothing.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the workers and forget what is queued. It may be called twice.

        Afterwards nothing is completed and no worker is busy.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class WorkerPool(Executor):
    """An executor that a config can choose: it starts workers that hold the model."""

    name: ClassVar[str]
    """What the config calls it."""

    in_process: ClassVar[bool]
    """Whether simulations run in this process, which an FMU that crashes takes along."""

    on_cluster: ClassVar[bool] = False
    """Whether all pools of a process run on one cluster, which is joined once: see `join`."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @classmethod
    def join(cls, workers: int | None, address: str | None) -> Callable[[], None]:
        """Join the cluster for longer than one pool; return how to leave it.

        `open` joins it too where that has not been done. Only asked for if `on_cluster`.

        Raises
        ------
        ExecutorError
            If it cannot be joined.
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
            What tasks refer to.
        workers
            How many; None for the executor's default. At most `model.at_most(workers)` are started,
            and worker i is given `model.of_worker(i)`.
        address
            Of a cluster, for executors that have one.
        limits
            When a simulation is ended from outside, for executors that can.

        Raises
        ------
        ModelError
            If the FMU cannot be loaded where it should run.
        ExecutorError
            If there are no workers to be had.
        """

    first: Outcome | None = None
    """What a worker answered before the first simulation that counts, if it was asked."""
    first_at: float = 0.0
    """When that was, in seconds of `time.monotonic`."""

    @abstractmethod
    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        """Have one worker answer tasks in turn, always the same one, while nothing else is asked.

        Each is asked once, even if it crashes. Their ids may be used again. Empty if that worker
        was lost.

        Parameters
        ----------
        tasks
            What to ask.
        last
            Whether to ask the last worker, not the first.
        """


class OutcomeSource(ABC):
    """Outcomes that are known already, such as those in the log of an interrupted run.

    They are numbered in the order in which they came, and each is given out once.
    """

    remaining: int
    """How many nobody has taken yet."""

    @abstractmethod
    def take(self, questions: Sequence[tuple[str, Want]]) -> list[int | None]:
        """Return, for each simulation key and want, the first outcome that nobody has taken."""

    @abstractmethod
    def is_whole(self, row: int) -> bool:
        """Return whether all of an outcome is known, so that it need not be simulated again."""

    @abstractmethod
    def outcome(self, row: int, task: int) -> Outcome:
        """Return an outcome as the answer to a task."""

    @abstractmethod
    def compare(self, row: int, outcome: Outcome) -> None:
        """Compare an outcome that was simulated again with what is known of the first."""

    @abstractmethod
    def note_answered(self, task: int) -> None:
        """Remember that a task was answered from here: it must not be logged again."""
