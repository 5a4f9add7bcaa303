"""The time and memory of a simulation, and the executor that suits it."""

from __future__ import annotations

import os

from cluster_est.executors.backlog import BATCH_SECONDS
from cluster_est.preflight.findings import CheckFinding, CheckVerdict
from cluster_est.preflight.subject import CheckSubject, unanswered
from workers.probes.probes import CostProbe, SimulationCost
from workers.process.forked import CAN_FORK
from workers.process.trial import NoAnswer

MOST_SECONDS = 1.0
"""Time for the measurement, where it suffices."""
ENOUGH = 150
"""Simulations for which there is time with any longer time for all checks."""
SHORT = 2e-4
"""Seconds: shorter simulations are not worth the way to another process."""
LONG = 1.0
"""Seconds: so long a simulation is worth a plan that asks for few of them."""
LEAST_COUNT = 100
"""Simulations from which on a leak can be told."""
LEAK = 1024.0
"""Bytes for each simulation: less is no leak."""


def costs(subject: CheckSubject) -> list[CheckFinding]:
    """Return the median time of a simulation, and the memory that each leaves behind."""
    seconds = max(
        min(MOST_SECONDS, subject.budget.left / 3.0),
        min(ENOUGH * subject.simulation_seconds, subject.budget.left / 4.0),
    )
    probe = CostProbe(*subject.probe_arguments, seconds)
    found = subject.ask(probe, 10)
    if isinstance(found, NoAnswer):
        return (
            [_one_measured(subject), unanswered("memory", found)]
            if subject.simulation_seconds
            else []
        )
    return [
        _time(subject, found.seconds, found.count),
        *_few_simulations(found.seconds),
        _memory(subject, found),
    ]


def _few_simulations(seconds: float) -> list[CheckFinding]:
    """Recommend what asks for few simulations where each of them takes long."""
    if seconds < LONG:
        return []
    said = (
        "a simulation takes long, and least_squares asks for more of them than it must, so that "
        "many workers have something to do: on the embedded example for 189 in place of 99"
    )
    do = (
        'with few workers method.options = { trials = 1, differences = "forward" }, and with ten '
        "unknowns or more secant_updates = 20 beside them; for methods de, pso and ga "
        "early_end = true"
    )
    return [CheckFinding(CheckVerdict.OK, "few simulations", said, do)]


def _one_measured(subject: CheckSubject) -> CheckFinding:
    return _time(subject, subject.simulation_seconds, 1)


def _time(subject: CheckSubject, seconds: float, count: int) -> CheckFinding:
    cores = os.cpu_count() or 1
    said = f"{_shown(seconds)} a simulation (median of {count})"
    together = round(BATCH_SECONDS / max(seconds, 1e-6))
    if together > 1:
        said += f"; a worker gets up to {together} at a time"
    if seconds < SHORT:
        said += "; too short to be worth the way to another process"
        do = "" if subject.in_process else 'executor.name = "local" is enough'
    elif cores > 1 and not CAN_FORK:
        do = f"executor.workers = {cores}"
    elif subject.in_process and cores > 1:
        do = f'executor.name = "processes" and executor.workers = {cores}, or "ray" for a cluster'
    else:
        do = ""
    return CheckFinding(CheckVerdict.OK, "cost", said, do)


def _shown(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"


def _memory(subject: CheckSubject, found: SimulationCost) -> CheckFinding:
    if found.leak is None or (found.count < LEAST_COUNT and found.leak < 50.0 * LEAK):
        said = f"{found.count} simulations are too few to see a leak"
        do = "give it more time with --seconds"
        return CheckFinding(CheckVerdict.NOT_DONE, "memory", said, do)
    if found.leak < LEAK:
        return CheckFinding(CheckVerdict.OK, "memory", f"no leak in {found.count} simulations")
    said = f"leaks {found.leak / 1024:.3g} kB a simulation"
    lasts = subject.growth / found.leak
    if subject.in_process:
        do = 'executor.name = "processes", whose processes are replaced as they grow'
        return CheckFinding(CheckVerdict.NOTE, "memory", said, do)
    said += f"; its process is replaced after about {lasts:.3g} of them (executor.growth)"
    return CheckFinding(CheckVerdict.NOTE, "memory", said)
