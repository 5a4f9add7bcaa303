"""A Ray actor around a supervised evaluator."""

from __future__ import annotations

import ray

from workers.messages import Experiment, Limits, Model
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import OutcomeColumns, TaskBatch


@ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)
class FmuActor:
    """An actor whose FMU lives in another process. Ray never restarts it: the pool replaces it."""

    def __init__(
        self, model: Model, experiments: tuple[Experiment, ...], limits: Limits, name: str
    ) -> None:
        self._evaluator = SupervisedEvaluator(model, experiments, name, limits)

    def ready(self) -> bool:
        """Return once the FMU is loaded; raise what went wrong otherwise."""
        return True

    def evaluate(self, batch: TaskBatch) -> OutcomeColumns:
        """Answer a batch of tasks."""
        return OutcomeColumns.of(self._evaluator.evaluate(batch))

    def once(self, batch: TaskBatch) -> OutcomeColumns:
        """Answer a batch of tasks, each at the first attempt."""
        return OutcomeColumns.of([self._evaluator.once(task) for task in batch.tasks()])
