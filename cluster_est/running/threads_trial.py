"""A test of whether several threads may simulate an FMU, with two simultaneous instances."""

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
    """A set of simulations that tests one property of an FMU.

    The trial depends on the values of parameters, experiments and solver settings, because an FMU
    may crash with some values only.

    Attributes
    ----------
    shows
        The tested property. "survived": it was simulated, reset and simulated again without a
        crash. "undisturbed": two simultaneous instances gave the same results as one instance.
    model, experiments, tasks
        The simulations.
    """

    shows: Literal["survived", "undisturbed"]
    model: Model
    experiments: Sequence[Experiment] = field(repr=False)
    tasks: Sequence[Task] = field(repr=False)

    @property
    def passed(self) -> bool:
        """True if the FMU passed this trial on this machine before."""
        return self._mark.exists()

    def remember(self) -> None:
        """Record that the FMU passed; if this fails, the trial is repeated the next time."""
        with contextlib.suppress(OSError):
            self._mark.touch()

    @cached_property
    def _mark(self) -> Path:
        """A file beside the unpacked FMU, named after a hash of the simulations."""
        parts: list[str | bytes] = [self.model.key]
        for task in self.tasks:
            experiment = self.experiments[task.experiment]
            parts += [task.values.tobytes(), repr((experiment.start, experiment.stop))]
            parts += [repr(experiment.values)]  # measurements have no effect
            for given in experiment.inputs:
                parts += [given.variable, given.interpolation]
                parts += [given.times.tobytes(), given.values.tobytes()]
        folder = unpacked_folder(self.model.archive_hash)
        return folder.with_name(f"{folder.name}.{self.shows}-{content_hash(parts)[:32]}")


PERTURBATION_FACTOR = 1.37
"""Ratio of the parameter values of the two simulations; not a round number."""
NO_HURRY = 1e6
"""Time limit in seconds, so long that results do not depend on the machine's speed."""
INSTANCES_AT_ONCE = 2
"""Number of simultaneous instances in the trial."""
DISTURBED = "give different results while another one is simulated"


def two_simulations(problem: Problem, first: int = 0) -> SideBySideProbe:
    """Return the probe of two simulations that differ in parameters and, if possible, known values.

    Parameters
    ----------
    problem
        The problem, which is simulated at its start values and at a point nearby.
    first
        Index of the first instance's experiment. The second instance's experiment has other known
        values, if possible.
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
    """Return the fault of two simultaneous instances in one process, as a verb; "" if none.

    The trial may crash, so it runs in a separate process if the system supports this.

    Parameters
    ----------
    problem
        The problem to simulate.
    make_room
        Called before the trial, to free instances if their number is limited.

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
