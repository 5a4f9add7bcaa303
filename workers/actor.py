"""A Ray actor around a supervised evaluator."""

from __future__ import annotations

import contextlib
import os

import ray

from workers.messages import Experiment, Limits, Model
from workers.process.forked import share_template
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import OutcomeColumns, TaskBatch


@ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)
class FmuActor:
    """An actor whose FMU runs in a separate process. Ray never restarts it; the pool replaces it.

    It loads the FMU only in `ready`, so that it can report its node before.
    """

    _evaluator: SupervisedEvaluator

    def __init__(
        self,
        model: Model,
        experiments: tuple[Experiment, ...],
        limits: Limits,
        pool: str,
        folder: str,
        name: str,
    ) -> None:
        self._installation = model, experiments, name, limits
        self._pool = pool
        if folder:  # the program's folder, in which FMUs may read files
            with contextlib.suppress(OSError):  # it was removed
                os.chdir(folder)

    def node(self) -> str:
        """Return the id of the actor's node."""
        return str(ray.get_runtime_context().get_node_id())

    def ready(self, worker: int) -> bool:
        """Load the FMU as one of the pool's workers, or raise an exception."""
        model, experiments, name, limits = self._installation
        model = model.of_worker(worker)
        share_template(self._pool)
        self._evaluator = SupervisedEvaluator(model, experiments, name, limits)
        return True

    def evaluate(self, batch: TaskBatch) -> OutcomeColumns:
        """Answer a batch of tasks."""
        return OutcomeColumns.of(self._evaluator.evaluate(batch))

    def free_instance(self) -> None:
        """Free the FMU's instance until the next task."""
        self._evaluator.free_instance()

    def once(self, batch: TaskBatch) -> OutcomeColumns:
        """Answer a batch of tasks with one attempt for each."""
        return OutcomeColumns.of([self._evaluator.once(task) for task in batch.tasks()])
