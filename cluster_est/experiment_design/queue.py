"""The queue of a design: workers for one set of experiments after the other, and one budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

from cluster_est.problem.problem import Problem
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.records import Budget, Record, TaskOrigin
from cluster_est.running.runner import Runner
from workers.messages import Experiment, Outcome

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
        environment = self._rest()
        with environment.executor(problem) as executor:
            runner = environment.runner(executor, record=self._named(problem), whole=True)
            runner.display.phase = phase
            try:
                return step(runner)
            finally:
                self.evaluations += runner.evaluations
                self.simulations += runner.simulations
                self.failures += runner.failures

    def _rest(self) -> RunEnvironment:
        """The environment with what is left of the budget."""
        resources = self._environment.resources
        budget = resources.budget
        points, seconds = budget.evaluations, budget.seconds
        if points is not None:
            points = max(points - self.evaluations, 0)
        if seconds is not None:
            seconds = max(seconds - (time.monotonic() - self._begin), 0.0)
        rest = replace(resources, budget=Budget(points, seconds))
        return replace(self._environment, resources=rest)

    def _named(self, problem: Problem) -> Record | None:
        """The monitor's record, told which experiment is meant where it is none of the run's."""
        record = self._environment.monitor.record
        if record is None:
            return None

        def told(origin: TaskOrigin, outcome: Outcome) -> None:
            experiment = problem.experiments[origin.experiment]
            record(replace(origin, installed=(experiment.id, experiment.key)), outcome)

        return told
