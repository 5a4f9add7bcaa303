"""Simulations as a worker does them, by an evaluator that is closed again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from workers.evaluate import Evaluator
from workers.messages import Experiment, Model, Outcome, Task
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
