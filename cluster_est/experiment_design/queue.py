"""The queue of a design: workers for one set of experiments after the other, and one budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

from cluster_est.problem.problem import Problem
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.runner import Runner
from workers.messages import Experiment

Found = TypeVar("Found")


class DesignQueue:
    """Opens workers for the experiments of each step, and counts what they simulate.

    Parameters
    ----------
    environment
        Workers, budget, and who is told.
    problem
        Whose model is simulated.
    """

    def __init__(self, environment: RunEnvironment, problem: Problem) -> None:
        self._environment, self._problem = environment, problem
        self._begin = time.monotonic()
        self.evaluations, self.simulations, self.failures = 0, 0, 0

    def use(
        self, experiments: Sequence[Experiment], phase: str, step: Callable[[Runner], Found]
    ) -> Found:
        """Do a step with a runner whose executor has these experiments.

        Raises
        ------
        ClusterEstError
            If there are no workers, or the budget is used up.
        """
        problem = replace(self._problem, experiments=tuple(experiments))
        environment = self._environment.left(self.evaluations, time.monotonic() - self._begin)
        with environment.executor(problem) as executor:
            runner = environment.runner(executor, record=environment.record_of(problem), whole=True)
            runner.display.phase = phase
            try:
                return step(runner)
            finally:
                self.evaluations += runner.evaluations
                self.simulations += runner.simulations
                self.failures += runner.failures
