"""What every simulation begins with: a reset, a new instance or a new process.

Most FMUs can be reset, which costs microseconds. Some keep something: a state, a table, values that
were set once. What is simulated then depends on what was simulated before, without any sign of it.
So the first worker is asked the same question twice before a search begins, however long that
takes: what simulations begin with must not depend on how quick a machine is. If the answers are not
the same bits, a new instance for each simulation is tried, then a new process. With slow FMUs it is
two or three simulations beside hundreds; `model.reset` in the config saves them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from cluster_est.errors import ExecutorError
from cluster_est.executors import WorkerPool, executor_class
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import make_space
from workers.errors import ModelError
from workers.messages import Experiment, Limits, Outcome, Renewal, Task

WAYS: tuple[Renewal, ...] = ("reset", "instance", "process")
BEGINS = {
    "reset": "a reset of the instance",
    "instance": "a new instance",
    "process": "a new process",
}
"""What each simulation begins with."""


@dataclass(frozen=True)
class ResetDecision:
    """What every simulation of a run begins with, and why.

    Attributes
    ----------
    renew
        One of `WAYS`.
    sentence
        What was found.
    plain
        Whether that is nothing out of the ordinary.
    """

    renew: Renewal
    sentence: str
    plain: bool = False


def recorded(facts: Mapping[str, Any]) -> ResetDecision | None:
    """What every simulation of a run began with, by its run.json; None if that does not say."""
    found = facts.get("renewal") or {}
    if found.get("renew") not in WAYS:
        return None
    return ResetDecision(found["renew"], str(found.get("sentence")), bool(found.get("plain")))


@dataclass(frozen=True)
class RepeatabilityTest:
    """What the first worker is asked: the first task again after the others."""

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
        """Whether the answers are the same bits; None if that cannot be found out."""
        (first,) = executor.first_worker(self.tasks[:1]) or (None,)
        if first is None or not first.ok:
            return None
        rest = executor.first_worker(self.tasks[1:])
        return bool(rest) and rest[-1].ok and _bits(rest[-1]) == _bits(first)


def open_renewing(
    problem: Problem,
    name: str,
    workers: int | None,
    address: str | None,
    limits: Limits,
    known: ResetDecision | None,
) -> tuple[WorkerPool, ResetDecision]:
    """Start the workers, with what every simulation has to begin with.

    Parameters
    ----------
    name, workers, address, limits
        Of the executor.
    known
        What an interrupted run had chosen, if this one goes on with it.

    Raises
    ------
    ExecutorError
        If this executor cannot give each simulation a process of its own, and the FMU needs that.
    ModelError
        If the FMU cannot be loaded.
    """

    def start(kind: str, renew: Renewal, count: int | None) -> WorkerPool:
        model = replace(problem.model, renew=renew)
        return executor_class(kind).open(model, problem.experiments, count, address, limits)

    declared = problem.model.renew
    if known is None and declared != "auto":
        said = f"each simulation begins with {BEGINS[declared]}, as model.reset says"
        known = ResetDecision(declared, said, plain=True)
    if known is not None:
        return start(name, known.renew, workers), known
    executor = start(name, "reset", workers)
    try:
        question = RepeatabilityTest.of(problem)
        same = question.ask(executor)
    except BaseException:
        executor.close()
        raise
    if same is None:
        return executor, ResetDecision("reset", _UNKNOWN, plain=True)
    if same:
        return executor, ResetDecision(
            "reset", "a reset instance is as good as a new one", plain=True
        )
    executor.close()
    return _other_way(problem.model.name, name, workers, question, start)


_UNKNOWN = (
    "it could not be tried whether a reset instance is as good as a new one, because the first "
    "simulation failed"
)


def _other_way(
    file: str,
    name: str,
    workers: int | None,
    question: RepeatabilityTest,
    start: Callable[[str, Renewal, int | None], WorkerPool],
) -> tuple[WorkerPool, ResetDecision]:
    """The least that lets the question have one answer; a reset if nothing does."""
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
