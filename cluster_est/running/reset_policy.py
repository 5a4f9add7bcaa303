"""The reset policy: each simulation begins with a reset, a new instance or a new process.

Most FMUs can be reset within microseconds. Some keep data through a reset: a state, a table, or
values that were set once. Their results then silently depend on earlier simulations. So before a
search, the first worker repeats a simulation. There is no time limit, because the policy must not
depend on the speed of the machine. If the results differ in a bit, a new instance for each
simulation is tried, and then a new process. The test takes two or three simulations; `model.reset`
in the config disables it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from cluster_est.errors import UnsuitableExecutorError
from cluster_est.executors import WorkerPool, executor_class
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.running.resources import Resources
from cluster_est.running.threads_trial import INSTANCES_AT_ONCE, Trial, what_disturbs
from workers.errors import ModelError
from workers.messages import Experiment, Limits, Outcome, ResetPolicy, Status, Task
from workers.process.forked import CAN_FORK

WAYS: tuple[ResetPolicy, ...] = ("reset", "instance", "process")
NO_ANSWER = (Status.LOST_WORKER, Status.TIMEOUT, Status.OUT_OF_MEMORY)
"""Statuses of a simulation without information about its results."""
LATER_SECONDS = 1.1
"""Seconds after which a clock that counts whole seconds has changed."""
LONG_SECONDS, LONG_AT_THE_END = 60.0, 5.0
"""Longest simulation that is repeated for a comparison: before a run, and at its end."""
NO_LIMITS = Limits(*[float("inf")] * 4)
BEGINNING_OF_SIMULATION = {
    "reset": "a reset of the instance",
    "instance": "a new instance",
    "process": "a new process",
}
"""Texts for the beginning of each simulation, by policy."""


@dataclass(frozen=True)
class ResetDecision:
    """The reset policy of a run, and the reason for it.

    Attributes
    ----------
    policy
        One of `WAYS`.
    sentence
        Reason for the decision, for the user.
    plain
        Whether the result of the test is normal.
    """

    policy: ResetPolicy
    sentence: str
    plain: bool = False


def recorded(facts: Mapping[str, Any]) -> ResetDecision | None:
    """Return the decision in the facts of a run.json; None if there is none."""
    found = facts.get("reset_policy") or {}
    if found.get("policy") not in WAYS:
        return None
    return ResetDecision(found["policy"], str(found.get("sentence")), bool(found.get("plain")))


@dataclass(frozen=True)
class RepeatabilityAnswer:
    """The result of a `RepeatabilityTest`.

    Attributes
    ----------
    same
        Whether the repeated outcome has the same bits; None if unknown.
    crashed
        Whether the process crashed, in the first simulation if `same` is None, else in a later one.
    message
        The fault as a verb with its object, or the message of the first simulation.
    first
        The first outcome, if it was reproduced.
    at
        Time of the test, in seconds of `time.monotonic`.
    """

    same: bool | None
    crashed: bool = False
    message: str = ""
    first: Outcome | None = None
    at: float = 0.0

    def keep(self, pool: WorkerPool, test: RepeatabilityTest) -> None:
        """Keep the first simulation with the pool, to repeat it later."""
        pool.first, pool.first_task, pool.first_at = self.first, test.tasks[0], self.at


@dataclass(frozen=True)
class RepeatabilityTest:
    """A test of the first worker, which repeats the first task after the others."""

    tasks: tuple[Task, ...]

    @classmethod
    def of(cls, problem: Problem) -> RepeatabilityTest:
        """Return the test of a problem: an experiment, another experiment, and the first again.

        The second experiment sets as many other variables as possible, so that data kept through
        a reset affect the repetition.
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

    def ask(self, executor: WorkerPool) -> RepeatabilityAnswer:
        """Run each task once on the first worker, and compare."""
        (first,) = executor.one_worker(self.tasks[:1]) or (None,)
        if first is None or not first.ok:
            crashed = first is not None and first.status is Status.CRASH
            return RepeatabilityAnswer(None, crashed, first.message if first is not None else "")
        rest = executor.one_worker(self.tasks[1:])
        if not all(outcome.ok for outcome in rest[:-1]):
            # after a failure, the last task may have begun without a reset: repeat it
            rest = executor.one_worker(self.tasks[:1])
        if not rest or rest[-1].status in NO_ANSWER:
            return RepeatabilityAnswer(None, message=rest[-1].message if rest else "")
        last = rest[-1]
        if last.ok and _bits(last) == _bits(first):
            return RepeatabilityAnswer(True, first=first, at=time.monotonic())
        if last.ok:
            return RepeatabilityAnswer(False, message="keeps data through a reset")
        crashed = last.status is Status.CRASH
        what = "crashes" if crashed else "fails"
        return RepeatabilityAnswer(
            False, crashed, f"{what} in a simulation after a reset ({last.message})"
        )


class _Start(Protocol):
    """A function that starts workers of an executor with a reset policy."""

    def __call__(self, kind: str, policy: ResetPolicy, count: int | None) -> WorkerPool: ...


def open_with_reset(
    problem: Problem, resources: Resources, known: ResetDecision | None = None
) -> tuple[WorkerPool, ResetDecision]:
    """Start the workers, and decide the reset policy.

    Parameters
    ----------
    problem, resources
        The problem, and the executor with its limits.
    known
        The decision of an interrupted run that is resumed.

    Raises
    ------
    ExecutorError
        If the FMU needs a separate process for each simulation, and the executor does not support
        this. Or if the executor has several workers in this process, and their instances disturb
        each other.
    ModelError
        If the FMU cannot be loaded.
    """
    pool, decision = _open(problem, resources, known)
    try:
        disturbs = _disturbance(problem, resources, pool)
        if disturbs and resources.workers is not None:
            raise UnsuitableExecutorError(
                f"executor.workers: {pool.workers} workers in this process need instances of "
                f"{problem.model.name} that do not disturb each other, but two instances "
                f'{disturbs}; choose executor.name = "processes" or "ray", or set executor.workers '
                "= 1"
            )
    except BaseException:
        pool.close()
        raise
    if disturbs:
        pool.close()
        pool, decision = _open(problem, replace(resources, workers=1), decision)
    pool.reset = decision.policy
    return pool, decision


def _disturbance(problem: Problem, resources: Resources, pool: WorkerPool) -> str:
    """Return how instances in this process disturb each other; "" if they do not."""
    if not (pool.in_process and pool.workers > 1):
        return ""
    if resources.instances is None:
        return what_disturbs(problem)
    limited = replace(problem, model=resources.limited(problem.model))
    return what_disturbs(limited, lambda: pool.free_instances(INSTANCES_AT_ONCE))


def _open(
    problem: Problem, resources: Resources, known: ResetDecision | None
) -> tuple[WorkerPool, ResetDecision]:
    """Start workers and decide as `open_with_reset`, without the test of several instances."""

    def start(kind: str, policy: ResetPolicy, count: int | None) -> WorkerPool:
        model = replace(problem.model, reset=policy, seats=resources.seats)
        # a trial in another executor has no limits, like an executor in this process
        limits = resources.limits if kind == resources.executor else NO_LIMITS
        pool = executor_class(kind)
        if not (CAN_FORK or pool.in_process):
            raise UnsuitableExecutorError(
                f'executor.name: "{kind}" needs a system that can fork processes, such as Linux or '
                'macOS, but this system cannot; choose "local"'
            )
        if policy == "process" and pool.in_process:
            raise UnsuitableExecutorError(
                'model.reset: "process" needs workers in separate processes, but executor.name is '
                f'"{kind}"; set executor.name to "processes" or "ray"'
            )
        return pool.open(model, problem.experiments, count, resources.address, limits)

    if problem.model.working_folder and executor_class(resources.executor).in_process:
        raise UnsuitableExecutorError(
            "model.working_folder: needs workers in separate processes (a process has only one "
            f'working folder), but executor.name is "{resources.executor}"; set executor.name to '
            '"processes" or "ray"'
        )
    declared = problem.model.reset
    if known is None and declared != "auto":
        said = (
            f"each simulation begins with {BEGINNING_OF_SIMULATION[declared]}, as set by "
            "model.reset"
        )
        known = ResetDecision(declared, said, plain=True)
    if known is not None:
        return start(resources.executor, known.policy, resources.workers), known
    return _find_policy(problem, resources, start)


_UNKNOWN = (
    "each simulation begins with a reset, but the reset could not be tested, because a "
    "simulation at the start values gave no result"
)


def _find_policy(
    problem: Problem, resources: Resources, start: _Start
) -> tuple[WorkerPool, ResetDecision]:
    """Find the cheapest policy with repeatable results.

    An FMU without a passed trial on this machine is tested in a separate process: it may crash, or
    depend on its process.
    """
    file, here = problem.model.name, executor_class(resources.executor).in_process
    question = RepeatabilityTest.of(problem)
    trial = Trial("survived", problem.model, problem.experiments, question.tasks)
    apart = (here or resources.executor == "processes") and CAN_FORK and not trial.passed
    answers: dict[ResetPolicy, RepeatabilityAnswer] = {}
    for policy in WAYS if CAN_FORK or not here else WAYS[:-1]:
        elsewhere = apart or (here and policy == "process")
        where = ("processes", 1) if elsewhere else (resources.executor, resources.workers)
        try:
            pool = start(where[0], policy, where[1])
        except ModelError:
            if policy == "reset":
                raise
            continue
        try:
            answers[policy] = question.ask(pool)
            decision = _decide(file, answers)
        except BaseException:
            pool.close()
            raise
        if decision is not None and not elsewhere:
            answers[policy].keep(pool, question)
            if pool.on_cluster:
                decision = _compared(problem, pool, decision, last=True)
            return pool, decision
        pool.close()
        if decision is not None:
            if here:
                _refuse_here(file, resources.executor, policy, answers[policy])
            pool = start(resources.executor, decision.policy, resources.workers)
            answers[policy].keep(pool, question)
            return pool, _tried(problem, pool, decision, trial)
    decision = _never_the_same(file, answers)
    return start(resources.executor, decision.policy, resources.workers), decision


def _tried(
    problem: Problem, pool: WorkerPool, decision: ResetDecision, trial: Trial
) -> ResetDecision:
    """Compare again after a second, and record the trial as passed if nothing was found."""
    if not trial.passed:
        decision = _compared(problem, pool, decision, later=True)
        if decision.plain:
            trial.remember()
    return decision


def compared_at_the_end(
    problem: Problem, pool: WorkerPool, decision: ResetDecision
) -> ResetDecision:
    """Repeat the first simulation at the end of a run; return the decision after the comparison.

    There is no comparison if workers are busy, as after an interrupt, or if it would take long.
    """
    if pool.busy or pool.first is None or pool.first.seconds > LONG_AT_THE_END:
        return decision
    # on a cluster there was no later comparison before the run
    return _compared(problem, pool, decision, later=pool.on_cluster)


def _compared(
    problem: Problem,
    pool: WorkerPool,
    decision: ResetDecision,
    *,
    last: bool = False,
    later: bool = False,
) -> ResetDecision:
    """Repeat the first simulation and compare; return the decision after the comparison.

    `last` selects the last worker instead of the first. `later` waits until a clock of whole
    seconds has changed.
    """
    first, task = pool.first, pool.first_task
    if first is None or task is None or first.seconds > LONG_SECONDS:
        return decision
    if later:
        time.sleep(max(0.0, pool.first_at + LATER_SECONDS - time.monotonic()))
    again = pool.one_worker([task], last=last)
    if all(not outcome.ok or _bits(outcome) == _bits(first) for outcome in again):
        return decision
    return ResetDecision(
        decision.policy,
        f"{problem.model.name} is not repeatable: the same simulation gives a different result in "
        "another process, at a later time, or after other simulations. So this run may not be "
        "repeatable either; test the FMU with cluster-est check",
    )


def _decide(file: str, answers: Mapping[ResetPolicy, RepeatabilityAnswer]) -> ResetDecision | None:
    """Return the decision from the answers so far; None if another policy must be tried."""
    policy, answer = list(answers.items())[-1]
    if policy == "reset":
        if answer.same is None:
            said = f"{_UNKNOWN} ({answer.message})" if answer.message else _UNKNOWN
            return ResetDecision("reset", said)
        said = "a reset instance gives the same results as a new one"
        return ResetDecision("reset", said, plain=True) if answer.same else None
    if not answer.same:
        return None
    begins = BEGINNING_OF_SIMULATION[policy]
    said = f"{file} {answers['reset'].message}, so each simulation begins with {begins}"
    return ResetDecision(policy, said)


def _never_the_same(file: str, answers: Mapping[ResetPolicy, RepeatabilityAnswer]) -> ResetDecision:
    """Return the cheapest policy without a crash, for an FMU that is not repeatable."""
    safe = [policy for policy, answer in answers.items() if not answer.crashed]
    said = (
        f"{file} is not repeatable: the same simulation gives a different result each time, even "
        f"in a new {'process' if 'process' in answers else 'instance'}. So this run may not be "
        "repeatable either"
    )
    return ResetDecision(safe[0] if safe else "reset", said)


def _refuse_here(
    file: str, executor: str, policy: ResetPolicy, answer: RepeatabilityAnswer
) -> None:
    """Raise an error if an FMU must not run in this process: it crashes or keeps data."""
    if answer.same is None and answer.crashed:
        raise UnsuitableExecutorError(
            f"executor.name: {file} cannot be run in this process, because its first simulation "
            f'crashed ({answer.message}); choose "processes" or "ray", where a crash ends only '
            "that simulation"
        )
    if policy == "process":
        raise UnsuitableExecutorError(
            f"executor.name: {file} keeps data from one simulation to the next, even in a new "
            f'instance, so each simulation needs its own process, but "{executor}" runs all of '
            'them in one process; choose "processes" or "ray", or set model.reset = "reset" if '
            "these data do not affect the results"
        )


def _set_by(experiment: Experiment) -> set[str]:
    return {name for name, _ in experiment.values}


def _bits(outcome: Outcome) -> bytes:
    found = b"" if outcome.residuals is None else outcome.residuals.tobytes()
    return found + outcome.constraints.tobytes()
