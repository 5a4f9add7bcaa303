"""A study: a question to a problem, which is checked before anything is simulated and then run.

A fit, a sensitivity analysis, a closed loop and a design are studies. Python makes one from
arguments, a config from its sections, and a sweep makes many; all are checked and run the same way.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from cluster_est.running.arguments import checked_resources
from cluster_est.running.environment import Monitor, RunEnvironment, SharedPools
from cluster_est.running.progress_line import Callback, note_of, progress_of
from cluster_est.running.resources import Record, Resources, Show

Answer = TypeVar("Answer", covariant=True)


class Study(ABC, Generic[Answer]):
    """A question to a problem, with all settings that its answer depends on.

    The answer does not depend on the environment: it is the same for any number of workers.
    """

    @abstractmethod
    def check(self) -> None:
        """Refuse what cannot be answered; nothing is simulated.

        Raises
        ------
        ClusterEstError
            If a setting is of the wrong kind or out of its range, or problem and settings do not
            fit together.
        """

    @abstractmethod
    def run(self, environment: RunEnvironment) -> Answer:
        """Simulate, and answer.

        Parameters
        ----------
        environment
            Workers, budget, who is told of the simulations, and what an interrupted run has left.

        Raises
        ------
        ClusterEstError
            If model, experiments and machine do not fit together.
        """


def run_study(
    study: Study[Answer],
    resources: Resources | Mapping[str, Any] | str | None = None,
    *,
    progress: Show | bool | None = None,
    callback: Callback | None = None,
    record: Record | None = None,
) -> Answer:
    """Check a study and run it on workers of its own.

    Parameters
    ----------
    study
        What to do.
    resources
        Where simulations run, and the budget.
    progress, callback, record
        See `progress_of`, `note_of` and `Runner`.

    Raises
    ------
    ClusterEstError
        As `Study.check` and `Study.run`.
    """
    study.check()
    resources = checked_resources(resources)
    note = note_of(callback)
    shown = progress_of(progress, resources.budget)
    with SharedPools() as pools, shown as show:  # a cluster is joined once
        environment = RunEnvironment(resources, Monitor(record, show, note), source=pools)
        return study.run(environment)
