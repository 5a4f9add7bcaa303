"""The thin Ray shell around a guarded evaluator."""

from __future__ import annotations

import ray

from workers.messages import Experiment, Limits, Model
from workers.process.supervisor import Guard
from workers.wire import Answers, Batch


@ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)
class Worker:
    """An actor whose FMU lives in another process. Ray never restarts it: the pool replaces it."""

    def __init__(
        self, model: Model, experiments: tuple[Experiment, ...], limits: Limits, name: str
    ) -> None:
        self._guard = Guard(model, experiments, name, limits)

    def ready(self) -> bool:
        """Return once the FMU is loaded; raise what went wrong otherwise."""
        return True

    def evaluate(self, batch: Batch) -> Answers:
        """Answer a batch of tasks."""
        return Answers.of(self._guard.evaluate(batch))
