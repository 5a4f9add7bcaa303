from collections.abc import Sequence
from typing import Any

import numpy as np

from workers.evaluate import Evaluator
from workers.messages import Effect, Experiment, Model, Outcome, Task
from workers.wire import TaskBatch


def answers(model: Model, experiments: Sequence[Experiment], tasks: list[Task]) -> list[Outcome]:
    """The outcomes of tasks that are asked in one batch."""
    evaluator = Evaluator(model, experiments, "test")
    try:
        return evaluator.evaluate(TaskBatch.of(tasks))
    finally:
        evaluator.close()


def answer(model: Model, experiment: Experiment, values: Any = (), *more: Any) -> Outcome:
    """The outcome of one task; what is wanted of it, and effects, may follow the values."""
    task = Task(0, 0, np.array(values, np.float64), *more)
    (outcome,) = answers(model, (experiment,), [task])
    return outcome


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
    wanted = ("trajectory", tuple(effects))
    outcome = answer(model, experiment, point, *wanted)
    assert outcome.trajectory is not None, outcome.message
    return outcome.trajectory.values
