"""The recipe of a preflight: what is looked at, in which order, while there is time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cluster_est.preflight.costs import costs
from cluster_est.preflight.findings import CheckFinding, CheckPage
from cluster_est.preflight.parameters import bounds, corners, effects
from cluster_est.preflight.repeating import instances, repeating
from cluster_est.preflight.solving import accuracy, derivatives, stiffness
from cluster_est.preflight.subject import CheckSubject, TimeBudget
from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation
from cluster_est.running.resources import Resources
from workers.messages import Outcome, Status, Task
from workers.probes.probes import CompileProbe, SimulationProbe
from workers.process.trial import NoAnswer, ProbeBench

SECONDS = 4.0
"""What all checks may take, once there is a process to take them to."""
COMPILE_SECONDS = 120.0
"""For a loop that only checks need; read from disk ever after."""
LOADING, ONE = 0.6, 0.6
"""Shares of the time left that loading the FMU, and one simulation, may take."""

CHECKS: tuple[Callable[[CheckSubject], list[CheckFinding]], ...] = (
    lambda subject: [instances(subject)],
    effects,
    stiffness,
    accuracy,
    costs,
    corners,
    derivatives,
)
"""In the order in which they get the time."""


def examine(
    problem: Problem, resources: Resources, seconds: float = SECONDS, *, declared: bool = True
) -> CheckPage:
    """Look at all that keeps an FMU from being fitted, or makes that slow or wrong.

    Every call of the FMU is in a process of its own, which is ended when its time is over.

    Parameters
    ----------
    problem
        What is to be fitted.
    resources
        Where it is to be fitted.
    seconds
        That the checks share. Loading the project itself takes a second or two beside. With 0
        the FMU is not tried at all.
    declared
        Whether somebody wants the parameters to be estimated.
    """
    description = problem.describe()
    if seconds == 0.0:
        return CheckPage((), ())
    with ProbeBench(problem.model, problem.experiments) as bench:
        loaded = bench.ask(None, 1e4 if seconds == np.inf else max(seconds, 1.0) * LOADING)
        if isinstance(loaded, NoAnswer):
            return CheckPage((_not_loaded(loaded),), (), loads=False)
        if problem.model.interface == "model_exchange":
            bench.ask(CompileProbe(), COMPILE_SECONDS)
        growth, clock = resources.limits.growth, TimeBudget.of(seconds)
        where = resources.executor, resources.workers, growth
        subject = CheckSubject(problem, description, bench, clock, *where, declared=declared)
        simulations = _simulate(subject)
        lines = [CheckFinding("ok", "loads", "it can be loaded and instantiated"), *bounds(subject)]
        lines += _simulated(subject, simulations)
        good = [s for s in simulations if s.outcome.ok]
        if good:
            first = min(good, key=lambda s: s.outcome.seconds)
            seen = first.outcome.trajectory
            subject = replace(
                subject,
                one=first.outcome.seconds,
                experiment=first.experiment,
                seen=None if seen is None or problem.effects else seen.values,
            )
            repeated, renew = repeating(subject)
            lines += repeated
            subject = replace(subject, renew=renew or "reset", repeats=renew is not None)
        late = any(s.outcome.status is Status.TIMEOUT for s in simulations)
        for check in CHECKS if good else () if late else (stiffness,):
            lines += check(subject)
    return CheckPage(tuple(lines), tuple(simulations))


def _not_loaded(stopped: NoAnswer) -> CheckFinding:
    do = "check that it does not wait for a licence or a window" if stopped.late else ""
    return CheckFinding("problem", "loads", stopped.message, do)


def _simulate(subject: CheckSubject) -> list[Simulation]:
    """Each experiment once, at the start values, as far as there is time."""
    problem, space = subject.problem, subject.space
    values = space.physical(space.start)
    found: list[Simulation] = []
    for e in range(len(problem.experiments)):
        limit = ONE * subject.clock.left
        if limit < 0.1 * subject.clock.seconds and found:
            outcome = Outcome(e, Status.NOT_RUN, message="no time was left for it")
            found.append(Simulation(e, outcome))
            continue
        task = Task(e, e, values[e], "trajectory", problem.effects)
        answer = subject.bench.ask(SimulationProbe(task), limit)
        if isinstance(answer, NoAnswer):
            status = Status.TIMEOUT if answer.late else Status.CRASH
            answer = Outcome(e, status, message=answer.message, seconds=np.nan)
        found.append(Simulation(e, answer))
    return found


def _simulated(subject: CheckSubject, simulations: list[Simulation]) -> list[CheckFinding]:
    """A line for all experiments that can be simulated, and one for each that cannot."""
    good = [s for s in simulations if s.outcome.ok]
    lines = []
    for simulation in simulations:
        outcome = simulation.outcome
        name = f"experiment {subject.problem.experiments[simulation.experiment].id}"
        if outcome.status is Status.NOT_RUN:
            lines.append(CheckFinding("not done", name, outcome.message, _MORE))
        elif outcome.status is Status.TIMEOUT:
            said = f"at the start values {outcome.message}"
            lines.append(CheckFinding("problem", name, said, f"if it is only slow: {_MORE}"))
        elif not outcome.ok:
            said = f"at the start values: {outcome.status}: {outcome.message}"
            lines.append(CheckFinding("problem", name, said, "other start values"))
    if good:
        said = f"{len(good)} of {len(simulations)} experiments, at the start values"
        lines.append(CheckFinding("ok", "simulates", said))
    return lines


_MORE = "give it more time with --seconds"
