"""An executor with a cache of outcomes, for several loops on one case.

    with remembering("name of the case") as resources:
        result = close_loop(problem, resources)

A loop without one of its parts mostly needs simulations of the complete loop. The outcome of a
simulation is a function of its task. So the loop's result and its number of simulations are the
same; only its duration has no meaning.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Self, final
from unittest.mock import patch

import numpy as np
from typing_extensions import override

from cluster_est import Resources
from cluster_est.executors import EXECUTORS
from cluster_est.executors.local import AnyEvaluator, EvaluatorHere, ThreadPool
from cluster_est.executors.log_replay import simulation_key
from workers.evaluate import Evaluator
from workers.fmu.process_environment import set_environment_here
from workers.messages import Experiment, Limits, Model, Outcome, Task
from workers.wire import TaskBatch


@dataclass
class OutcomeMemory:
    """A cache of outcomes; the least recently used outcomes are removed first.

    Attributes
    ----------
    most
        Largest number of bytes of arrays.
    held
        Current number of bytes.
    asked, simulated
        Numbers of requested outcomes, and of those that were not in the cache.
    case
        The case of the loops.
    """

    most: int
    held: int = 0
    asked: int = 0
    simulated: int = 0
    case: str = ""
    _outcomes: OrderedDict[str, Outcome] = field(default_factory=OrderedDict, repr=False)

    def get(self, key: str) -> Outcome | None:
        """Return an outcome, or None."""
        self.asked += 1
        known = self._outcomes.get(key)
        if known is None:
            self.simulated += 1
        else:
            self._outcomes.move_to_end(key)
        return known

    def keep(self, key: str, outcome: Outcome) -> None:
        """Store an outcome, whose arrays must not be changed any more."""
        if key in self._outcomes:
            return
        self._outcomes[key] = outcome
        self.held += _frozen_bytes(outcome)
        while self.held > self.most and len(self._outcomes) > 1:
            _, oldest = self._outcomes.popitem(last=False)
            self.held -= _frozen_bytes(oldest)

    def begin(self, case: str) -> None:
        """Remove the outcomes of other cases."""
        if case != self.case:
            self._outcomes.clear()
            self.case, self.held = case, 0


KNOWN = OutcomeMemory(most=2 * 2**30)
"""The cache of this process, for all executors of all loops on a case."""


def _frozen_bytes(given: Any) -> int:
    """Make all arrays in a message read-only, and return their bytes."""
    if isinstance(given, np.ndarray):
        given.flags.writeable = False
        return given.nbytes
    if is_dataclass(given):
        return sum(_frozen_bytes(getattr(given, each.name)) for each in fields(given))
    return 0


@final
class RememberingEvaluator:
    """Wraps an evaluator, and calls it only for outcomes that are not in the cache."""

    def __init__(
        self, inner: AnyEvaluator, model: Model, experiments: Sequence[Experiment]
    ) -> None:
        self._inner, self._model = inner, model.key
        self._experiments = [experiment.key for experiment in experiments]
        self.free_instance, self.stop, self.close = inner.free_instance, inner.stop, inner.close

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Answer a batch in its order."""
        tasks = batch.tasks()
        keys = [self._key(task) for task in tasks]
        known = [KNOWN.get(key) for key in keys]
        new = [task for task, outcome in zip(tasks, known, strict=True) if outcome is None]
        simulated = iter(self._inner.evaluate(TaskBatch.of(new)) if new else [])
        answers = []
        for task, key, old in zip(tasks, keys, known, strict=True):
            outcome = next(simulated) if old is None else replace(old, task=task.id)
            KNOWN.keep(key, outcome)
            answers.append(outcome)
        return answers

    def once(self, task: Task) -> Outcome:
        """Answer one task by a simulation, because it is compared with an earlier one."""
        return self._inner.once(task)

    def _key(self, task: Task) -> str:
        experiment = self._experiments[task.experiment]
        key = simulation_key(self._model, experiment, task.effects, task.values, task.bound)
        return f"{task.want} {key}"


class RememberingExecutor(ThreadPool):
    """One evaluator in this process, with the cache."""

    name: ClassVar[str] = "remembering"
    in_process: ClassVar[bool] = True

    @classmethod
    @override
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
        limits: Limits | None = None,
    ) -> Self:
        set_environment_here(model)
        inner = EvaluatorHere(Evaluator(model.of_worker(0), experiments, cls.name))
        return cls([RememberingEvaluator(inner, model, experiments)])


@contextmanager
def remembering(case: str) -> Iterator[Resources]:
    """Yield resources with one worker in this process and the cache of a case.

    The name of its executor is defined while the context lasts. Outcomes of other cases are
    removed.
    """
    KNOWN.begin(case)
    where = f"{__name__}:{RememberingExecutor.__name__}"
    with patch.dict(EXECUTORS, {RememberingExecutor.name: where}):
        yield Resources(executor=RememberingExecutor.name)
