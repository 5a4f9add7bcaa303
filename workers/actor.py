"""The thin Ray shell around an evaluator."""

from __future__ import annotations

import ray

from workers.evaluate import Evaluator
from workers.messages import Experiment, Model
from workers.wire import Answers, Batch


@ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)
class Worker:
    """An actor that holds a loaded FMU. It is never restarted by Ray: the pool replaces it."""

    def __init__(self, model: Model, experiments: tuple[Experiment, ...], name: str) -> None:
        self._evaluator = Evaluator(model, experiments, name)

    def ready(self) -> bool:
        """Return once the FMU is loaded; raise what went wrong otherwise."""
        return True

    def evaluate(self, batch: Batch) -> Answers:
        """Answer a batch of tasks."""
        return Answers.of(self._evaluator.evaluate(batch))
