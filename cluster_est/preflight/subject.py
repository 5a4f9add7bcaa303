"""What is examined, and with how much time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cluster_est.preflight.findings import CheckFinding
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import SearchSpace, make_space
from workers.fmu.description import ModelDescription
from workers.messages import FloatArray, ResetPolicy
from workers.probes.base import FmuProbe
from workers.process.trial import NoAnswer, ProbeBench

LEAST_SECONDS = 0.2
"""With less left nothing more is asked."""


@dataclass
class TimeBudget:
    """Seconds that all checks share."""

    seconds: float
    begun: float

    @classmethod
    def of(cls, seconds: float) -> TimeBudget:
        return cls(seconds, time.monotonic())

    @property
    def left(self) -> float:
        return self.begun + self.seconds - time.monotonic()


@dataclass(frozen=True)
class CheckSubject:
    """A problem on a bench.

    Attributes
    ----------
    executor, workers
        Name of the one that the config chooses, and how many workers.
    growth
        Bytes after which its processes are replaced.
    one
        Seconds of one simulation of `experiment`, measured at first.
    experiment
        The one that is tried out.
    renew
        What its simulations begin with, as soon as that is known.
    repeats
        Whether a simulation gives the same twice, so that small differences mean something.
    declared
        Whether somebody wants the parameters to be estimated.
    seen : (times, outputs)
        What a process of its own made of the experiment, if known.
    """

    problem: Problem
    description: ModelDescription
    bench: ProbeBench
    clock: TimeBudget
    executor: str = "local"
    workers: int | None = None
    growth: float = 256.0 * 2**20
    one: float = 0.0
    experiment: int = 0
    renew: ResetPolicy = "reset"
    repeats: bool = True
    declared: bool = True
    seen: FloatArray | None = None

    @property
    def where(self) -> tuple[int, FloatArray, ResetPolicy]:
        """What probes begin with: experiment, values, and how each simulation begins."""
        return self.experiment, self.start, self.renew

    @cached_property
    def space(self) -> SearchSpace:
        return make_space(self.problem, tuple(range(len(self.problem.experiments))))

    @cached_property
    def start(self) -> FloatArray:
        """(values,): of the model's parameters at the start, in the experiment."""
        return self.at(self.space.start)

    def at(self, x: FloatArray) -> FloatArray:
        """The same at a point of the space."""
        count = len(self.problem.model.parameters)
        return np.ascontiguousarray(self.space.physical(x)[self.experiment, :count])

    def ask(self, probe: FmuProbe, simulations: int, most: float = 2.0) -> Any:
        """Ask, if there is time for so many simulations; `NoAnswer` if not."""
        left = self.clock.left
        needed = simulations * self.one
        if left < max(LEAST_SECONDS, needed):
            return NoAnswer(f"it would take about {max(needed, LEAST_SECONDS):.2g} s", late=True)
        return self.bench.ask(probe, min(left, max(most, 3.0 * needed)))


def unanswered(check: str, stopped: NoAnswer) -> CheckFinding:
    """The line of a check that came to nothing."""
    if stopped.late:
        more = "give it more time with --seconds"
        return CheckFinding("not done", check, f"no time left: {stopped.message}", more)
    return CheckFinding("note", check, f"could not be found out: {stopped.message}")
