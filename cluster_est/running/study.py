"""Studies: analyses of a problem, which are checked before any simulation and then run.

A fit, a sensitivity analysis, a closed loop and a design are studies. Python creates a study from
arguments, a config from its sections, and a sweep creates many studies. All are checked and run in
the same way.
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
    """An analysis of a problem, with all settings that affect its result.

    The result does not depend on the environment: it is the same for any number of workers.
    """

    @abstractmethod
    def check(self) -> None:
        """Raise an error if the study cannot be run, without any simulation.

        Raises
        ------
        ClusterEstError
            If a setting is of the wrong kind or out of its range, or problem and settings do not
            fit together.
        """

    @abstractmethod
    def run(self, environment: RunEnvironment) -> Answer:
        """Run the study and return its result.

        Parameters
        ----------
        environment
            Workers, budget, listeners, and the log of an interrupted run.

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
    """Check a study and run it with its own workers.

    Parameters
    ----------
    study
        The study to run.
    resources
        Executor, budget and limits.
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
    with SharedPools() as pools, shown as show:  # joins a cluster only once
        environment = RunEnvironment(resources, Monitor(record, show, note), source=pools)
        return study.run(environment)
