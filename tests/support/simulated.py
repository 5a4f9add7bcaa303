"""Simulations of one worker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from workers.evaluate import Evaluator
from workers.messages import Effect, Experiment, Model, Task
from workers.wire import TaskBatch


class Worker:
    """Answers with the outputs of one experiment, (times, outputs), of a model."""

    def __init__(self, model: Model, experiment: Experiment) -> None:
        self.evaluator = Evaluator(model, (experiment,), "w")

    def outputs(self, *points: Sequence[float], effects: Sequence[Effect] = ()) -> list[np.ndarray]:
        """The outputs at points, of one batch: values of the parameters and coefficients."""
        tasks = [
            Task(i, 0, np.array(point, dtype=float), "trajectory", tuple(effects))
            for i, point in enumerate(points)
        ]
        found = self.evaluator.evaluate(TaskBatch.of(tasks))
        assert all(outcome.ok for outcome in found), [outcome.message for outcome in found]
        return [outcome.trajectory.values for outcome in found if outcome.trajectory is not None]


def simulated(
    model: Model, experiment: Experiment, point: Sequence[float], effects: Sequence[Effect] = ()
) -> np.ndarray:
    """The outputs of one simulation, (times, outputs)."""
    worker = Worker(model, experiment)
    (found,) = worker.outputs(point, effects=effects)
    worker.evaluator.close()
    return found
