"""Whether an FMU may be simulated by several threads: two instances are tried side by side."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space.space import SearchSpace, make_space
from cluster_est.running.trials.known_fmus import Trial
from workers.messages import FloatArray, Task
from workers.probes.side_by_side import InstanceSimulation, SideBySideProbe
from workers.process.trial import NoAnswer, ProbeBench

FACTOR = 1.37
"""Between the values of the two instances: no round number."""
NO_HURRY = 1e6
"""Seconds: a clock must not decide what a run may do."""
TOGETHER = 2
"""Instances that are tried at once."""
DISTURBED = "give other results while another one is simulated"


def two_simulations(problem: Problem, first: int = 0) -> SideBySideProbe:
    """Return the probe whose two simulations differ in as much as a problem has to offer.

    Parameters
    ----------
    problem
        What is simulated, at its start values and somewhat beside them.
    first
        Index of the experiment of one instance. The other one's has other known values, if there
        are any.
    """
    space = make_space(problem, tuple(range(len(problem.experiments))))
    own = problem.experiments[first].values
    others = [e for e, each in enumerate(problem.experiments) if each.values != own]
    second = others[0] if others else first
    count = len(problem.model.parameters)
    one = space.physical(space.start)[first, :count]
    other = space.physical(_beside(space))[second, :count]
    return SideBySideProbe(InstanceSimulation(first, one), InstanceSimulation(second, other))


def what_disturbs(problem: Problem, make_room: Callable[[], None] | None = None) -> str:
    """Return what two instances in one process do if both are used, as a verb; "" if nothing bad.

    That is tried in a process of its own, where there are such processes: it may crash.

    Parameters
    ----------
    problem
        What is simulated.
    make_room
        Called before: it lets so many instances go, where their number is limited.

    Raises
    ------
    OSError
        If no process can be started.
    """
    probe = two_simulations(problem)
    tasks = [Task(i, s.experiment, s.point) for i, s in enumerate((probe.one, probe.other))]
    trial = Trial("undisturbed", problem.model, problem.experiments, tasks)
    if trial.passed:
        return ""
    if make_room is not None:
        make_room()
    with ProbeBench.open(problem.model, problem.experiments) as bench:
        found = bench.ask(probe, NO_HURRY)
        if isinstance(found, NoAnswer) and found.crashed:
            alone = SideBySideProbe(probe.one, probe.other, together=False)
            survives = bench.ask(alone, NO_HURRY) is False
            return f"crash ({found.message})" if survives else ""
    if found is False:
        trial.remember()
    return DISTURBED if found is True else ""


def _beside(space: SearchSpace) -> FloatArray:
    """Return a point near the start, within the bounds."""
    searched = []
    for unknown in space.unknowns:
        start, low, high = unknown.start, unknown.parameter.lower, unknown.parameter.upper
        choices = (FACTOR * start, start / FACTOR) if start != 0.0 else (FACTOR, -FACTOR)
        inside = [each for each in choices if low <= each <= high]
        near = inside[0] if inside else min(max(choices[0], low), high)
        searched.append(unknown.to_search(near))
    return np.clip(np.array(searched, np.float64), space.lower, space.upper)
