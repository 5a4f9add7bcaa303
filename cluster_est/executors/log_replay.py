"""An executor that takes outcomes from a log, to resume an interrupted run."""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Sequence

from cluster_est.executors.executor import Executor, OutcomeSource
from workers.messages import (
    Effect,
    Experiment,
    FloatArray,
    Model,
    Outcome,
    ResetPolicy,
    Task,
    content_hash,
)


def simulation_key(
    model_key: str,
    experiment_key: str,
    effects: tuple[Effect, ...],
    values: FloatArray,
    bound: float = math.inf,
    step_limit: int = 0,
) -> str:
    """Return the hash of all data that affect a simulation's outcome.

    `bound` is the sum of squares above which the simulation ends early; for `step_limit` see
    `Task`.
    """
    parts: list[str | bytes] = [model_key, experiment_key, repr(effects), values.tobytes()]
    if bound < math.inf:
        parts.append(bound.hex())
    if step_limit:
        parts.append(f"{step_limit} steps")
    return content_hash(parts)


class LogReplayExecutor(Executor):
    """An executor that takes outcomes from a log, and sends other tasks to another executor.

    The resumed run starts from its beginning. A task with an outcome in the log is *held*. The
    outcomes of held tasks are returned one at a time, in the log's order. So a method that depends
    on the order of outcomes takes the same path again. Other tasks wait until no task is held, so
    they can be cancelled as in the first run. A held task cannot be cancelled, because the first
    run did not cancel it.

    Log rows without residuals, or without a linearisation, are simulated again at once, and
    returned in their turn.

    A config cannot select this executor; `RunEnvironment` uses it to resume a run.

    Parameters
    ----------
    inner
        Executor of the simulations, which is closed with this executor.
    model, experiments
        Model and experiments of `inner`.
    log
        The known outcomes.
    """

    def __init__(
        self,
        inner: Executor,
        model: Model,
        experiments: Sequence[Experiment],
        log: OutcomeSource,
    ) -> None:
        self._inner = inner
        self._model_key = model.key
        self._experiment_keys = [experiment.key for experiment in experiments]
        self._log = log
        self._held: list[tuple[int, int]] = []  # row, task
        self._later: list[Task] = []
        self._early: dict[int, Outcome] = {}

    @property
    def workers(self) -> int:  # type: ignore[override]
        """Number of workers of the inner executor; a pool may grow."""
        return self._inner.workers

    @property
    def reset(self) -> ResetPolicy:  # type: ignore[override]
        """The reset policy of the inner executor."""
        return self._inner.reset

    def submit(self, tasks: Sequence[Task]) -> None:
        if self._log.remaining:
            rows = self._log.take([(self._key(task), task.want) for task in tasks])
        else:
            rows = [None] * len(tasks)
        again = []
        for task, row in zip(tasks, rows, strict=True):
            if row is None:
                self._later.append(task)
                continue
            heapq.heappush(self._held, (row, task.id))
            if not self._log.is_whole(row):
                again.append(task)
        if again:
            self._inner.submit(again)
        self._pass_on()

    def completed(self) -> list[Outcome]:
        while self._held:
            row, task = self._held[0]
            if self._log.is_whole(row):
                outcome = self._log.outcome(row, task)
            elif task in self._early:
                outcome = self._early.pop(task)
                self._log.compare(row, outcome)
            else:
                self._early |= {outcome.task: outcome for outcome in self._inner.completed()}
                continue
            heapq.heappop(self._held)
            self._log.note_answered(task)
            return [outcome]
        self._pass_on()
        if self._early:
            outcomes = list(self._early.values())
            self._early.clear()
            return outcomes
        return self._inner.completed()

    def cancel(self, tasks: Collection[int]) -> list[int]:
        wanted = set(tasks).difference(task for _, task in self._held)
        found = [task.id for task in self._later if task.id in wanted]
        if found:
            self._later = [task for task in self._later if task.id not in wanted]
        return found + self._inner.cancel(wanted.difference(found))

    @property
    def busy(self) -> int:
        return self._inner.busy

    def free_instances(self, workers: int) -> None:
        self._inner.free_instances(workers)

    def close(self) -> None:
        self._held.clear()
        self._later.clear()
        self._inner.close()

    def _pass_on(self) -> None:
        """Submit the waiting tasks to the inner executor if no task is held."""
        if self._later and not self._held:
            later, self._later = self._later, []
            self._inner.submit(later)

    def _key(self, task: Task) -> str:
        experiment = self._experiment_keys[task.experiment]
        return simulation_key(
            self._model_key, experiment, task.effects, task.values, task.bound, task.step_limit
        )
