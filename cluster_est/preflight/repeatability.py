"""Checks that a simulation is repeatable: reset, instances and randomness."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.preflight.solver_checks import longest_step
from cluster_est.preflight.subject import (
    CheckFinding,
    CheckSubject,
    CheckVerdict,
    fault,
    listed,
    not_done,
    note,
    passed,
    unanswered,
)
from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation
from cluster_est.running import reset_policy
from cluster_est.running.threads_trial import DISTURBED, PERTURBATION_FACTOR, two_simulations
from workers.messages import FloatArray, ResetPolicy, Status
from workers.probes.other_simulations import RemedyProbe, SimulationVariant
from workers.probes.probes import (
    InstanceProbe,
    LeftoverProbe,
    RepeatProbe,
    RepetitionResult,
    StopTimeProbe,
    differences,
)
from workers.process.forked import CAN_FORK
from workers.process.trial import NoAnswer

FRESH = "processes" if CAN_FORK else "instances"
EarlierSimulation = tuple[float, FloatArray] | None
"""Start time of a simulation, and its outputs."""
TRIED_RESET_POLICIES: tuple[tuple[ResetPolicy, ...], ...] = (
    ("reset", "instance"),
    ("instance",),
    (),
)
"""Sets of policies to try, one after the other as long as the process crashes."""


def repeatable(
    subject: CheckSubject,
) -> tuple[list[CheckFinding], ResetPolicy | None, EarlierSimulation]:
    """Compare a reset instance with a new one, and two new processes (or instances).

    Also return the reset policy for all further checks, None if no policy makes simulations in one
    process repeatable, and the simulation for `later`.
    """
    begun = time.monotonic()
    crash = ""
    for policies in TRIED_RESET_POLICIES:
        probe = RepeatProbe(subject.experiment, subject.start, policies)
        found = subject.ask(probe, 2)
        if not isinstance(found, NoAnswer) or found.late:
            break
        crash = crash or found.message
    if isinstance(found, NoAnswer):
        return [unanswered("repeatable", found)], "reset", None
    again = subject.trajectory
    if again is None or again.tobytes() != found.first.tobytes():  # it was simulated after a reset
        other = subject.ask(probe, 2)
        if isinstance(other, NoAnswer):
            return [unanswered("repeatable", other)], "reset", None
        again = other.first
    if again.tobytes() != found.first.tobytes():
        how = f"two simulations in fresh {FRESH} differ"
        return [_not_repeatable(subject, again, found.first, how)], None, None
    same = passed("repeatable", f"two simulations in fresh {FRESH} are identical bit for bit")
    lines = [same, _reset(subject, found, crash)]
    if found.reset == 0.0:
        return lines + _leftovers(subject), "reset", (begun, found.first)
    policy: ResetPolicy | None = "instance" if found.instance == 0.0 else None
    return lines, policy, (begun, found.first)


def later(subject: CheckSubject, earlier: EarlierSimulation) -> list[CheckFinding]:
    """Compare a simulation with one more than a second earlier, in another process."""
    if earlier is None:
        return []
    begun, first = earlier
    wait = max(begun + reset_policy.LATER_SECONDS - time.monotonic(), 0.0)
    if wait > subject.budget.left:
        said = "not repeated a second later, because there was no time left"
        return [not_done("later", said, "give it more time with --seconds")]
    time.sleep(wait)
    found = subject.ask(RepeatProbe(subject.experiment, subject.start, ()), 1)
    if isinstance(found, NoAnswer):
        return [unanswered("later", found)]
    if found.first.tobytes() == first.tobytes():
        said = "a simulation a second later is identical bit for bit"
        return [passed("later", said)]
    how = "a simulation a second later differs"
    return [_not_repeatable(subject, first, found.first, how)]


def _not_repeatable(
    subject: CheckSubject, one: FloatArray, other: FloatArray, how: str
) -> CheckFinding:
    names = subject.problem.experiments[subject.experiment].recorded
    far = dict(zip(names, differences(one, other).tolist(), strict=True))
    differing = [name for name in names if not far[name] <= 0.0]
    sizes = [f"{name} (by {far[name]:.2g} of its size)" for name in differing]
    said = f"no: {how} in {listed(sizes)}"
    do = (
        "export the FMU without a random generator or clock, or choose a method.name that uses no "
        'differences, such as "pattern_search"'
    )
    if len(differing) < len(names):
        do = (
            "leave out outputs that are not needed, such as a counter of processor time; "
            f"otherwise, {do}"
        )
    return fault("repeatable", said, do)


def _reset(subject: CheckSubject, found: RepetitionResult, crash: str) -> CheckFinding:
    if found.reset == 0.0:
        return passed(
            "reset",
            "a simulation after a reset is identical to one in a fresh instance, bit for bit",
        )
    how = f"a simulation after a reset fails{f': {crash}' if crash else ''}"
    if found.reset is not None:
        how = (
            f"a simulation after a reset differs from one in a fresh instance by {found.reset:.2g} "
            "of the outputs' size"
        )
    if found.instance == 0.0:
        do = 'model.reset = "auto" handles this, with a new instance for each simulation'
        return _reset_advice(subject, "instance", how, do)
    do = 'model.reset = "auto" handles this, with a new process for each simulation'
    if subject.in_process:
        do = 'set executor.name = "processes", so that each simulation can have a new process'
        return fault("reset", how, do)
    return _reset_advice(subject, "process", how, do)


def _reset_advice(subject: CheckSubject, needed: str, how: str, do: str) -> CheckFinding:
    policy = subject.problem.model.reset
    if policy in ("auto", needed, "process"):
        return note("reset", how, do)
    return fault("reset", how, f'set model.reset = "{needed}" or "auto"')


def _leftovers(subject: CheckSubject) -> list[CheckFinding]:
    """Return a note if values survive a reset; it matters if experiments differ in values."""
    other = np.where(subject.start == 0.0, PERTURBATION_FACTOR, PERTURBATION_FACTOR * subject.start)
    found = subject.ask(LeftoverProbe(subject.experiment, other), 3)
    if isinstance(found, NoAnswer):  # a failure with the FMU's own values is irrelevant for a fit
        return [unanswered("values", found)] if found.late else []
    if found == 0.0:
        return []
    return [
        note(
            "values",
            "values that were set survive a reset; this is harmless if each simulation sets them "
            "again, as in a fit",
            "if the experiments give values for different variables, give all experiments values "
            'for the same variables, or set model.reset = "instance"',
        )
    ]


def stop_time(subject: CheckSubject) -> CheckFinding:
    """Return whether the FMU needs the stop time of a simulation."""
    found = subject.ask(StopTimeProbe(subject.experiment, subject.start), 0)
    if isinstance(found, NoAnswer):
        return unanswered("stop time", found)
    without, told = found
    if without:
        said = "the FMU starts without a stop time" + ("" if told else ", but not with one")
        return passed("stop time", said)
    said = "the FMU can only be initialised with a stop time, so the stop time is passed to it"
    if subject.problem.model.stop_time:
        return passed("stop time", said)
    said += " after a first initialisation without it, which fails"
    do = "set model.stop_time = true in a config to avoid this failure"
    return note("stop time", said, do)


def instances(subject: CheckSubject) -> CheckFinding:
    """Return a finding on the number of instances in one process."""
    most = InstanceProbe().max_count
    allowed = most if subject.instances is None else min(most, subject.instances)
    if allowed == 1:
        said = "not tested, because executor.instances = 1 allows only one at a time"
        return passed("instances", said)
    found = subject.ask(InstanceProbe(allowed), 0, 3.0)
    if isinstance(found, NoAnswer):
        return unanswered("instances", found)
    declared = subject.description.offer(subject.problem.model.interface).once_per_process
    count, _ = found
    if count > 1 and not declared:
        return _side_by_side(subject, count)
    says = "as the FMU declares" if declared else "although the FMU does not declare this limit"
    if count > 1:
        says = "as the FMU declares, although more could be created"
    return _one_only(subject, f"one instance per process, {says}")


def _side_by_side(subject: CheckSubject, count: int) -> CheckFinding:
    """Return a finding on whether several instances can be simulated at the same time."""
    can_be = f"{count} instances at the same time in one process"
    found = subject.ask(two_simulations(subject.problem, subject.experiment), 4)
    if found is True:
        return _one_only(subject, f"{can_be}, but they {DISTURBED}")
    if isinstance(found, NoAnswer) and found.late:
        said = f"{can_be}; it is not known whether they disturb each other: {found.message}"
        return not_done("instances", said, "give it more time with --seconds")
    if isinstance(found, NoAnswer) and found.crashed:
        return _one_only(subject, f"{can_be}, but with two of them, {found.message}")
    if found is False:
        can_be += ", which do not disturb each other"
    return passed("instances", can_be)


def _one_only(subject: CheckSubject, said: str) -> CheckFinding:
    do = 'for several workers, set executor.name = "processes" or "ray"'
    several = subject.in_process and (subject.workers or 1) > 1
    verdict = CheckVerdict.PROBLEM if several else CheckVerdict.NOTE
    return CheckFinding(verdict, "instances", said, do)


COMMUNICATION_STEP_PARTS = (10.0, 100.0)
"""Divisors of the longest step that give communication steps to try."""
SIMULATIONS_OF_REMEDY = 20
"""Number of simulations for which there must be time. The FMU has just failed, so the time of a
simulation is unknown."""


@dataclass(frozen=True)
class Remedy:
    """A change with which the FMU can be simulated.

    Attributes
    ----------
    step
        Communication step in seconds; None if it does not help.
    refused
        Parameters in the model description that the FMU refuses to set; empty if omitting them does
        not help.
    """

    step: float | None = None
    refused: tuple[str, ...] = ()


def remedy(subject: CheckSubject, simulations: Sequence[Simulation]) -> Remedy:
    """Look for a change with which the first experiment can be simulated, if none can be.

    This is not tried if the FMU was too slow, or if its process crashed.
    """
    first = simulations[0]
    failed = first.outcome.status in (Status.SOLVER_FAILURE, Status.NOT_FINITE)
    if not failed or any(s.outcome.ok for s in simulations) or subject.problem.effects:
        return Remedy()
    subject = replace(subject, experiment=first.experiment)
    every = tuple(range(len(subject.problem.model.parameters)))
    steps = _steps(subject)
    works = _works(subject, [SimulationVariant(every, step) for step in steps])
    for step, good in zip(steps, works, strict=False):
        if good:
            return Remedy(step=step)
    if subject.declared or not every:
        return Remedy()
    alone = [SimulationVariant((), None), *(SimulationVariant((i,), None) for i in every)]
    works = _works(subject, alone)
    if len(works) < len(alone) or not works[0]:
        return Remedy()
    names = subject.problem.model.parameters
    return Remedy(refused=tuple(names[i] for i in every if not works[1 + i]))


def without_parameters(problem: Problem, names: Sequence[str]) -> Problem:
    """Return the problem with the FMU's own values for some parameters."""
    kept = tuple(name for name in problem.model.parameters if name not in names)
    return replace(
        problem,
        model=replace(problem.model, parameters=kept),
        parameters=tuple(p for p in problem.parameters if p.name not in names),
    )


def refused_parameters(names: Sequence[str]) -> CheckFinding:
    """Return a finding on parameters that cannot be set."""
    return note(
        "parameters",
        f"{listed(names)}: cannot be set in the FMU, although its modelDescription.xml says that "
        "this is possible; the check continued with the FMU's own values",
        "remove from the config what cannot be set, or ask the exporter of the FMU",
    )


def _steps(subject: CheckSubject) -> list[float]:
    """Return shorter communication steps, the FMU's own first; empty if there is no choice."""
    model, description = subject.problem.model, subject.description
    if model.interface != "co_simulation" or not description.variable_steps:
        return []
    longest = min(model.solver.step or math.inf, longest_step(subject))
    own = description.default_step
    steps = [own] if own is not None and 0.0 < own < longest else []
    return [*steps, *(longest / part for part in COMMUNICATION_STEP_PARTS)]


def _works(subject: CheckSubject, variants: Sequence[SimulationVariant]) -> list[bool]:
    """Return whether each variant can be simulated; fewer if there is no time for all."""
    if not variants:
        return []
    probe = RemedyProbe(
        subject.experiment, subject.start, tuple(variants), max(subject.budget.left / 3.0, 0.1)
    )
    answer = subject.ask(probe, SIMULATIONS_OF_REMEDY)
    return [] if isinstance(answer, NoAnswer) else list(answer)
