"""An executor that answers from memory what it has simulated before, for many loops on one case.

    with remembering("name of the case") as resources:
        result = close_loop(problem, resources)

A loop without one of its parts asks mostly for what the whole one has simulated. A simulation's
outcome follows from the bits of what is asked, so the loop's result is the same, and it counts its
simulations as ever; only its seconds mean nothing.
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
    """Outcomes by all that they depend on; what was used longest ago goes first.

    Attributes
    ----------
    most
        Bytes of arrays that are kept.
    held
        Bytes that are kept now.
    asked, simulated
        How many outcomes were asked for, and how many of those were not known.
    case
        What the loops are about.
    """

    most: int
    held: int = 0
    asked: int = 0
    simulated: int = 0
    case: str = ""
    _outcomes: OrderedDict[str, Outcome] = field(default_factory=OrderedDict, repr=False)

    def get(self, key: str) -> Outcome | None:
        """Return what is known."""
        self.asked += 1
        known = self._outcomes.get(key)
        if known is None:
            self.simulated += 1
        else:
            self._outcomes.move_to_end(key)
        return known

    def keep(self, key: str, outcome: Outcome) -> None:
        """Keep an outcome, whose arrays must not be changed from now on."""
        if key in self._outcomes:
            return
        self._outcomes[key] = outcome
        self.held += _frozen_bytes(outcome)
        while self.held > self.most and len(self._outcomes) > 1:
            _, oldest = self._outcomes.popitem(last=False)
            self.held -= _frozen_bytes(oldest)

    def begin(self, case: str) -> None:
        """Let all go that is about another case."""
        if case != self.case:
            self._outcomes.clear()
            self.case, self.held = case, 0


KNOWN = OutcomeMemory(most=2 * 2**30)
"""Of this process, for all executors of all loops on a case."""


def _frozen_bytes(given: Any) -> int:
    """Return the bytes of all arrays in a message, which can be written to no more."""
    if isinstance(given, np.ndarray):
        given.flags.writeable = False
        return given.nbytes
    if is_dataclass(given):
        return sum(_frozen_bytes(getattr(given, each.name)) for each in fields(given))
    return 0


@final
class RememberingEvaluator:
    """Stands before an evaluator, and asks it only for what is not known."""

    def __init__(
        self, inner: AnyEvaluator, model: Model, experiments: Sequence[Experiment]
    ) -> None:
        self._inner, self._model = inner, model.key
        self._experiments = [experiment.key for experiment in experiments]
        self.free_instance, self.stop, self.close = inner.free_instance, inner.stop, inner.close

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Answer a batch, in its order."""
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
        """Answer one task by a simulation: whoever asks so compares it with another one."""
        return self._inner.once(task)

    def _key(self, task: Task) -> str:
        experiment = self._experiments[task.experiment]
        key = simulation_key(self._model, experiment, task.effects, task.values, task.bound)
        return f"{task.want} {key}"


class RememberingExecutor(ThreadPool):
    """One evaluator in this process, with the memory before it."""

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
    """Give one worker in this process, with the memory of a case; that of another one goes.

    Its executor has a name while the context lasts.
    """
    KNOWN.begin(case)
    where = f"{__name__}:{RememberingExecutor.__name__}"
    with patch.dict(EXECUTORS, {RememberingExecutor.name: where}):
        yield Resources(executor=RememberingExecutor.name)
