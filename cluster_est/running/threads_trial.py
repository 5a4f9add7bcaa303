"""Whether an FMU may be simulated by several threads: two instances are tried side by side."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from workers.fmu.archive import unpacked_folder
from workers.messages import Experiment, FloatArray, Model, Task, content_hash
from workers.probes.other_simulations import InstanceSimulation, SideBySideProbe
from workers.process.trial import NoAnswer, ProbeBench


@dataclass(frozen=True)
class Trial:
    """Some simulations of an FMU, and what they are to show.

    Another value of a parameter, of an experiment or of the solver's settings makes another trial:
    an FMU may crash with one and not with the other.

    Attributes
    ----------
    shows
        It has "survived" if it was simulated, reset and simulated again without a crash; it was
        "undisturbed" if two instances at once gave what one alone gives.
    model, experiments, tasks
        The simulations.
    """

    shows: Literal["survived", "undisturbed"]
    model: Model
    experiments: Sequence[Experiment] = field(repr=False)
    tasks: Sequence[Task] = field(repr=False)

    @property
    def passed(self) -> bool:
        """True if that was shown here before."""
        return self._mark.exists()

    def remember(self) -> None:
        """Remember that; where it cannot be written down, the FMU is tried again the next time."""
        with contextlib.suppress(OSError):
            self._mark.touch()

    @cached_property
    def _mark(self) -> Path:
        """A file beside the unpacked FMU, named after all that was simulated."""
        parts: list[str | bytes] = [self.model.key]
        for task in self.tasks:
            experiment = self.experiments[task.experiment]
            parts += [task.values.tobytes(), repr((experiment.start, experiment.stop))]
            parts += [repr(experiment.values)]  # what was measured does not matter
            for given in experiment.inputs:
                parts += [given.variable, given.interpolation]
                parts += [given.times.tobytes(), given.values.tobytes()]
        folder = unpacked_folder(self.model.archive_hash)
        return folder.with_name(f"{folder.name}.{self.shows}-{content_hash(parts)[:32]}")


PERTURBATION_FACTOR = 1.37
"""Ratio of the values of two simulations that must not see each other: no round number."""
NO_HURRY = 1e6
"""Seconds: a clock must not decide what a run may do."""
INSTANCES_AT_ONCE = 2
"""Instances that are tried at once."""
DISTURBED = "give different results while another one is simulated"


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
        choices = (
            (PERTURBATION_FACTOR * start, start / PERTURBATION_FACTOR)
            if start != 0.0
            else (PERTURBATION_FACTOR, -PERTURBATION_FACTOR)
        )
        inside = [each for each in choices if low <= each <= high]
        near = inside[0] if inside else min(max(choices[0], low), high)
        searched.append(unknown.to_search(near))
    return np.clip(np.array(searched, np.float64), space.lower, space.upper)
