"""What lets an experiment be simulated that cannot be simulated as it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cluster_est.preflight.findings import CheckFinding, CheckVerdict, listed
from cluster_est.preflight.solver_checks import longest_step
from cluster_est.preflight.subject import CheckSubject
from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation
from workers.messages import Status
from workers.probes.remedies import RemedyProbe, SimulationVariant
from workers.process.trial import NoAnswer

SHORTER = (10.0, 100.0)
"""Parts of the longest step that are tried as communication steps."""
SIMULATIONS = 20
"""For which there must be time; the FMU has just failed, so nothing is known of how long one is."""


@dataclass(frozen=True)
class Remedy:
    """What lets it be simulated.

    Attributes
    ----------
    step
        Communication step in seconds; None if that is no remedy.
    refused
        Parameters that the FMU's description lists as such, and that it refuses to be set; empty if
        that is no remedy.
    """

    step: float | None = None
    refused: tuple[str, ...] = ()


def remedy(subject: CheckSubject, simulations: Sequence[Simulation]) -> Remedy:
    """Look for what lets the first experiment be simulated, where none can be.

    Nothing is looked for where an FMU was too slow, or took its process with it.
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
    """Return the same problem, in which some parameters keep the FMU's own values."""
    kept = tuple(name for name in problem.model.parameters if name not in names)
    return replace(
        problem,
        model=replace(problem.model, parameters=kept),
        parameters=tuple(p for p in problem.parameters if p.name not in names),
    )


def refused_parameters(names: Sequence[str]) -> CheckFinding:
    """Return a line for parameters that cannot be set."""
    return CheckFinding(
        CheckVerdict.NOTE,
        "parameters",
        f"{listed(names)}: the FMU refuses to be given a value, though its modelDescription.xml "
        "lists a parameter that can be set; checked without",
        "do not estimate it, or ask whoever exported the FMU",
    )


def _steps(subject: CheckSubject) -> list[float]:
    """Shorter communication steps, the FMU's own first; none where there is nothing to choose."""
    model, description = subject.problem.model, subject.description
    if model.interface != "co_simulation" or not description.variable_steps:
        return []
    longest = min(model.solver.step or math.inf, longest_step(subject))
    own = description.default_step
    steps = [own] if own is not None and 0.0 < own < longest else []
    return [*steps, *(longest / part for part in SHORTER)]


def _works(subject: CheckSubject, variants: Sequence[SimulationVariant]) -> list[bool]:
    """For each variant whether it can be simulated; fewer, where there was no time for all."""
    if not variants:
        return []
    probe = RemedyProbe(
        subject.experiment, subject.start, tuple(variants), max(subject.budget.left / 3.0, 0.1)
    )
    answer = subject.ask(probe, SIMULATIONS)
    return [] if isinstance(answer, NoAnswer) else list(answer)
