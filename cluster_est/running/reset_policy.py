"""The reset policy: each simulation begins with a reset, a new instance or a new process.

Most FMUs can be reset, which costs microseconds. Some keep something: a state, a table, values that
were set once. What is simulated then depends on what was simulated before, without any sign of it.
So the first worker is asked the same question twice before a search begins, however long that
takes: what simulations begin with must not depend on how quick a machine is. If the answers are not
the same bits, a new instance for each simulation is tried, then a new process. With slow FMUs it is
two or three simulations beside hundreds; `model.reset` in the config saves them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from cluster_est.errors import ExecutorError
from cluster_est.executors import WorkerPool, executor_class
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import make_space
from cluster_est.running.resources import Resources
from workers.errors import ModelError
from workers.messages import Experiment, Outcome, ResetPolicy, Status, Task

WAYS: tuple[ResetPolicy, ...] = ("reset", "instance", "process")
NO_ANSWER = (Status.LOST_WORKER, Status.TIMEOUT, Status.OUT_OF_MEMORY)
"""Ends of a simulation that say nothing of what it would have given."""
BEGINS = {
    "reset": "a reset of the instance",
    "instance": "a new instance",
    "process": "a new process",
}
"""What each simulation begins with."""


@dataclass(frozen=True)
class ResetDecision:
    """The reset policy of a run, and the reason for it.

    Attributes
    ----------
    renew
        One of `WAYS`.
    sentence
        What was found.
    plain
        Whether that is nothing out of the ordinary.
    """

    renew: ResetPolicy
    sentence: str
    plain: bool = False


def recorded(facts: Mapping[str, Any]) -> ResetDecision | None:
    """Return the decision that a run.json holds; None if it does not say."""
    found = facts.get("renewal") or {}
    if found.get("renew") not in WAYS:
        return None
    return ResetDecision(found["renew"], str(found.get("sentence")), bool(found.get("plain")))


@dataclass(frozen=True)
class RepeatabilityTest:
    """A test of the first worker: the first task again after the others."""

    tasks: tuple[Task, ...]

    @classmethod
    def of(cls, problem: Problem) -> RepeatabilityTest:
        """Experiment, another one that sets most of what this one does not, and the first again.

        What a reset leaves behind shows there at the latest.
        """
        first = min(
            range(len(problem.experiments)), key=lambda e: len(problem.experiments[e].values)
        )
        own = _set_by(problem.experiments[first])
        more = [len(_set_by(e) - own) for e in problem.experiments]
        asked = [first, *([more.index(max(more))] if max(more) else []), first]
        everything = tuple(range(len(problem.experiments)))
        space = make_space(problem, everything)
        values = space.physical(space.start)[:, : len(problem.model.parameters)]
        return cls(tuple(Task(i, e, values[e]) for i, e in enumerate(asked)))

    def ask(self, executor: WorkerPool) -> bool | None:
        """Return whether the answers are the same bits; None if that cannot be found out."""
        (first,) = executor.first_worker(self.tasks[:1]) or (None,)
        if first is None or not first.ok:
            return None
        rest = executor.first_worker(self.tasks[1:])
        if not rest or rest[-1].status in NO_ANSWER:
            return None
        return rest[-1].ok and _bits(rest[-1]) == _bits(first)


class _Start(Protocol):
    """Starts workers of an executor, whose simulations begin in some way."""

    def __call__(self, kind: str, renew: ResetPolicy, count: int | None) -> WorkerPool: ...


def open_with_reset(
    problem: Problem, resources: Resources, known: ResetDecision | None = None
) -> tuple[WorkerPool, ResetDecision]:
    """Start the workers, and decide what every simulation begins with.

    Parameters
    ----------
    problem, resources
        What is simulated, and where.
    known
        What was decided before, if an interrupted run is taken up again.

    Raises
    ------
    ExecutorError
        If this executor cannot give each simulation a process of its own, and the FMU needs that.
    ModelError
        If the FMU cannot be loaded.
    """

    def start(kind: str, renew: ResetPolicy, count: int | None) -> WorkerPool:
        model = replace(problem.model, reset=renew)
        where = count, resources.address, resources.limits
        return executor_class(kind).open(model, problem.experiments, *where)

    declared = problem.model.reset
    if known is None and declared != "auto":
        said = f"each simulation begins with {BEGINS[declared]}, as model.reset says"
        known = ResetDecision(declared, said, plain=True)
    if known is not None:
        return start(resources.executor, known.renew, resources.workers), known
    executor = start(resources.executor, "reset", resources.workers)
    try:
        question = RepeatabilityTest.of(problem)
        same = question.ask(executor)
    except BaseException:
        executor.close()
        raise
    if same is None:
        return executor, ResetDecision("reset", _UNKNOWN, plain=True)
    if same:
        said = "a reset instance is as good as a new one"
        return executor, ResetDecision("reset", said, plain=True)
    executor.close()
    return _other_way(problem.model.name, resources, question, start)


_UNKNOWN = (
    "it could not be tried whether a reset instance is as good as a new one, because the first "
    "simulation failed"
)


def _other_way(
    file: str, resources: Resources, question: RepeatabilityTest, start: _Start
) -> tuple[WorkerPool, ResetDecision]:
    """The least that lets the question have one answer; a reset if nothing does."""
    name, workers = resources.executor, resources.workers
    for renew in WAYS[1:]:
        elsewhere = renew == "process" and name == "local"
        try:
            executor = start("processes" if elsewhere else name, renew, 1 if elsewhere else workers)
        except ModelError:
            continue
        try:
            same = question.ask(executor)
        except BaseException:
            executor.close()
            raise
        if same and not elsewhere:
            said = (
                f"{file} keeps something through a reset: each simulation begins with "
                f"{BEGINS[renew]}"
            )
            return executor, ResetDecision(renew, said)
        executor.close()
        if same:
            raise ExecutorError(
                f"executor.name: {file} keeps something from one simulation to the next, even in "
                'a new instance, so each needs a process of its own, but "local" has one for all; '
                'choose "processes" or "ray", or set model.reset = "reset" if that does not matter'
            )
    said = (
        f"{file} does not repeat itself: the same simulation gives other results each time, even "
        "in a new process, and so may this run"
    )
    return start(name, "reset", workers), ResetDecision("reset", said)


def _set_by(experiment: Experiment) -> set[str]:
    return {name for name, _ in experiment.values}


def _bits(outcome: Outcome) -> bytes:
    found = b"" if outcome.residuals is None else outcome.residuals.tobytes()
    return found + outcome.constraints.tobytes()
