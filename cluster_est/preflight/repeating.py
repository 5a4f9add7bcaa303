"""Reset, instances and chance: whether a simulation is the same again."""

from __future__ import annotations

import numpy as np

from cluster_est.preflight.findings import CheckFinding, Verdict
from cluster_est.preflight.subject import CheckSubject, unanswered
from workers.messages import ResetPolicy
from workers.probes.probes import (
    InstanceProbe,
    LeftoverProbe,
    RepeatProbe,
    RepetitionResult,
    difference,
)
from workers.process.trial import NoAnswer

MOVED = 1.37
"""What every value is multiplied with, to see whether it stays behind: no round number."""


def repeating(subject: CheckSubject) -> tuple[list[CheckFinding], ResetPolicy | None]:
    """Whether reset equals fresh, and two fresh processes each other.

    And what a simulation must begin with, for all further checks; None if nothing helps.
    """
    probe = RepeatProbe(subject.experiment, subject.start)
    found = subject.ask(probe, 2)
    if isinstance(found, NoAnswer):
        return [unanswered("repeatable", found)], "reset"
    again = subject.seen
    if again is None or again.tobytes() != found.first.tobytes():  # that was after a reset
        other = subject.ask(probe, 2)
        if isinstance(other, NoAnswer):
            return [unanswered("repeatable", other)], "reset"
        again = other.first
    far = difference(again, found.first)
    if again.tobytes() != found.first.tobytes():
        said = f"no: two fresh processes differ by {far:.2g} of the outputs' size"
        do = (
            "export it without a random generator or clock; else choose a method.name that takes "
            'no differences, such as "pattern_search"'
        )
        return [CheckFinding("problem", "repeatable", said, do)], None
    repeatable = CheckFinding("ok", "repeatable", "two fresh processes give the same bits")
    renew: ResetPolicy = "reset" if found.reset == 0.0 else "instance"
    lines = [repeatable, _reset(subject, found)]
    return lines + (_left(subject) if renew == "reset" else []), renew


def _reset(subject: CheckSubject, found: RepetitionResult) -> CheckFinding:
    if found.reset == 0.0:
        return CheckFinding("ok", "reset", "a reset instance gives the same bits as a fresh one")
    how = "a simulation after a reset fails"
    if found.reset is not None:
        how = f"a reset instance is {found.reset:.2g} of the outputs' size away from a fresh one"
    if found.instance == 0.0:
        do = 'model.reset = "auto" sees to it: a new instance for each simulation'
        return _chosen(subject, "instance", how, do)
    do = 'model.reset = "auto" sees to it: a new process for each simulation'
    if subject.executor == "local":
        do = 'executor.name = "processes", for a new process for each simulation'
        return CheckFinding("problem", "reset", how, do)
    return _chosen(subject, "process", how, do)


def _chosen(subject: CheckSubject, needed: str, how: str, do: str) -> CheckFinding:
    renew = subject.problem.model.reset
    if renew in ("auto", needed, "process"):
        return CheckFinding("note", "reset", how, do)
    return CheckFinding("problem", "reset", how, f'set model.reset = "{needed}" or "auto"')


def _left(subject: CheckSubject) -> list[CheckFinding]:
    """What harms only where experiments set different values; nothing is said if it is not so."""
    other = np.where(subject.start == 0.0, MOVED, MOVED * subject.start)
    found = subject.ask(LeftoverProbe(subject.experiment, other), 3)
    if isinstance(found, NoAnswer) or found == 0.0:
        return []
    return [
        CheckFinding(
            "note",
            "values",
            "values that were set survive a reset; harmless where each simulation sets them again, "
            "as a fit does",
            "if experiments differ in the keys of their values, give all the same keys, or set "
            'model.reset = "instance"',
        )
    ]


def instances(subject: CheckSubject) -> CheckFinding:
    """How many there can be in one process."""
    found = subject.ask(InstanceProbe(), 0, 3.0)
    if isinstance(found, NoAnswer):
        return unanswered("instances", found)
    declared = subject.description.offer(subject.problem.model.interface).once_per_process
    count, _ = found
    if count > 1 and not declared:
        return CheckFinding("ok", "instances", f"{count} at once in a process")
    says = "and says so" if declared else "and does not say so"
    if count > 1:
        says = "as it says, though more could be made"
    do = 'for several workers: executor.name = "processes" or "ray"'
    verdict: Verdict = "problem" if subject.executor == "local" and _several(subject) else "note"
    return CheckFinding(verdict, "instances", f"one in a process, {says}", do)


def _several(subject: CheckSubject) -> bool:
    return (subject.workers or 1) > 1
