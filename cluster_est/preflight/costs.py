"""What a simulation costs: time, memory, and where it should run."""

from __future__ import annotations

import os

from cluster_est.executors.backlog import BATCH_SECONDS
from cluster_est.preflight.findings import CheckFinding
from cluster_est.preflight.subject import CheckSubject, unanswered
from workers.probes.probes import CostProbe, SimulationCost
from workers.process.trial import NoAnswer

SECONDS = 1.0
"""How long it is measured."""
QUICK = 2e-4
"""Simulations of less are not worth the way to another process."""
MANY = 100
"""Simulations from which a leak can be told."""
LEAK = 1024.0
"""Bytes: less for each simulation harms nobody."""


def costs(subject: CheckSubject) -> list[CheckFinding]:
    """The median time of a simulation, and what each leaves in memory."""
    probe = CostProbe(*subject.where, min(SECONDS, subject.clock.left / 3.0))
    found = subject.ask(probe, 10)
    if isinstance(found, NoAnswer):
        return [_known(subject), unanswered("memory", found)] if subject.one else []
    return [_time(subject, found.seconds, found.count), _memory(subject, found)]


def _known(subject: CheckSubject) -> CheckFinding:
    return _time(subject, subject.one, 1)


def _time(subject: CheckSubject, seconds: float, count: int) -> CheckFinding:
    cores = os.cpu_count() or 1
    said = f"{_shown(seconds)} a simulation (median of {count})"
    together = round(BATCH_SECONDS / max(seconds, 1e-6))
    if together > 1:
        said += f"; a worker gets up to {together} at a time"
    if seconds < QUICK:
        said += "; too short to be worth the way to another process"
        do = "" if subject.executor == "local" else 'executor.name = "local" is enough'
    elif subject.executor == "local" and cores > 1:
        do = f'executor.name = "processes" and executor.workers = {cores}, or "ray" for a cluster'
    else:
        do = ""
    return CheckFinding("ok", "cost", said, do)


def _shown(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"


def _memory(subject: CheckSubject, found: SimulationCost) -> CheckFinding:
    if found.leak is None or (found.count < MANY and found.leak < 50.0 * LEAK):
        said = f"{found.count} simulations are too few to see a leak"
        return CheckFinding("ok", "memory", said) if found.leak is not None else _few(said)
    if found.leak < LEAK:
        return CheckFinding("ok", "memory", f"no leak in {found.count} simulations")
    said = f"leaks {found.leak / 1024:.3g} kB a simulation"
    lasts = subject.growth / found.leak
    if subject.executor == "local":
        do = 'executor.name = "processes", whose processes are replaced as they grow'
        return CheckFinding("note", "memory", said, do)
    said += f"; its process is replaced after about {lasts:.3g} of them (executor.growth)"
    return CheckFinding("note", "memory", said)


def _few(said: str) -> CheckFinding:
    return CheckFinding("not done", "memory", said, "give it more time with --seconds")
