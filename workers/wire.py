"""Tasks and outcomes as columns, which are cheap to send between machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workers.messages import (
    Effect,
    FloatArray,
    IntArray,
    Linearisation,
    Outcome,
    Status,
    Task,
    Trajectory,
    Want,
)


@dataclass(frozen=True)
class TaskBatch:
    """Tasks for a worker, as columns.

    Attributes
    ----------
    ids, experiments : (n,)
    values : (n, k)
    want, effects
        The same for all tasks of the batch.
    bounds, step_limits : (n,)
        Bound and step limit of each task.
    """

    ids: IntArray
    experiments: IntArray
    values: FloatArray
    want: Want
    effects: tuple[Effect, ...]
    bounds: FloatArray
    step_limits: IntArray

    @classmethod
    def of(cls, tasks: Sequence[Task]) -> TaskBatch:
        """Pack tasks with the same `want` and the same effects.

        Raises
        ------
        ValueError
            If these differ.
        """
        first = tasks[0]
        if any(task.want != first.want or task.effects != first.effects for task in tasks):
            raise ValueError(
                "a batch: all tasks in it must ask for the same kind of answer with the same "
                "effects, but they differ; use TaskBacklog, which divides tasks into such batches"
            )
        return cls(
            ids=np.array([task.id for task in tasks], np.int64),
            experiments=np.array([task.experiment for task in tasks], np.int64),
            values=np.array([task.values for task in tasks], np.float64),
            want=first.want,
            effects=first.effects,
            bounds=np.array([task.bound for task in tasks], np.float64),
            step_limits=np.array([task.step_limit for task in tasks], np.int64),
        )

    def tasks(self) -> list[Task]:
        columns = self.ids, self.experiments, self.bounds, self.step_limits
        rows = zip(*(column.tolist() for column in columns), self.values, strict=True)
        return [
            Task(i, experiment, values, self.want, self.effects, bound, limit)
            for i, experiment, bound, limit, values in rows
        ]


@dataclass(frozen=True)
class OutcomeColumns:
    """Outcomes of a worker, as columns: one array to send instead of one for each outcome.

    Attributes
    ----------
    ids, lengths, seconds, steps : (n,)
        One value for each outcome; a length of -1 means that there are no residuals.
    residuals
        Residuals of all outcomes, concatenated.
    failures
        (status, message) by position, if the status is not OK or there is a message.
    trajectories, linearisations, constraints, sensitivities
        By position.
    worker
        Name of the worker.
    """

    ids: IntArray
    lengths: IntArray
    residuals: FloatArray
    seconds: FloatArray
    steps: IntArray
    failures: dict[int, tuple[Status, str]]
    trajectories: dict[int, Trajectory]
    linearisations: dict[int, Linearisation]
    constraints: dict[int, FloatArray]
    sensitivities: dict[int, FloatArray]
    worker: str

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> OutcomeColumns:
        """Pack the outcomes of one worker."""
        kept = [o.residuals for o in outcomes if o.residuals is not None]
        pairs = list(enumerate(outcomes))
        return cls(
            ids=np.array([o.task for o in outcomes], np.int64),
            lengths=np.array(
                [-1 if o.residuals is None else len(o.residuals) for o in outcomes], np.int64
            ),
            residuals=np.concatenate([np.zeros(0), *kept]),
            seconds=np.array([o.seconds for o in outcomes]),
            steps=np.array([o.steps for o in outcomes], np.int64),
            failures={i: (o.status, o.message) for i, o in pairs if o.message or not o.ok},
            trajectories={i: o.trajectory for i, o in pairs if o.trajectory is not None},
            linearisations={i: o.linearisation for i, o in pairs if o.linearisation is not None},
            constraints={i: o.constraints for i, o in pairs if len(o.constraints)},
            sensitivities={i: o.sensitivities for i, o in pairs if o.sensitivities is not None},
            worker=outcomes[0].worker if outcomes else "",
        )

    def outcomes(self) -> list[Outcome]:
        """Return the outcomes; their residuals are views of one array."""
        ends = np.cumsum(np.maximum(self.lengths, 0)).tolist()
        columns = zip(
            self.ids.tolist(),
            self.lengths.tolist(),
            ends,
            self.seconds.tolist(),
            self.steps.tolist(),
            strict=True,
        )
        found = []
        for i, (task, length, end, seconds, steps) in enumerate(columns):
            status, message = self.failures.get(i, (Status.OK, ""))
            residuals = None if length < 0 else self.residuals[end - length : end]
            trajectory = self.trajectories.get(i)
            found.append(
                Outcome(
                    task,
                    status,
                    residuals,
                    trajectory,
                    message,
                    seconds,
                    self.worker,
                    self.linearisations.get(i),
                    self.constraints.get(i, np.zeros(0)),
                    self.sensitivities.get(i),
                    steps,
                )
            )
        return found
