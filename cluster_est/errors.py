"""The exceptions of cluster-est.

All derive from one, and each text says where, what it must be, what it is and what to do::

    ClusterEstError
    |-- ConfigError       a config file or a key=value argument
    |-- DataError         a measured table or signal
    |-- ProblemError      parameters, experiments and methods that do not fit together
    |-- EffectError       an effect: unknown form, closed site, no equation
    |-- ModelError        the FMU: unreadable, not for this platform, lacks a variable
    |-- RunFolderError    a run folder that cannot be written or read
    |   `-- UnwritableError   a disk that is full, a folder that is gone or read-only
    |-- BudgetError       the budget was used up before there was a result
    `-- ExecutorError     no workers to be had
        `-- UnsuitableExecutorError   the chosen ones must not run this FMU

A simulation that fails is none of these: it is an `Outcome` with a status and a message.
"""

from __future__ import annotations

from workers.errors import ClusterEstError, DataError, EffectError, ModelError

__all__ = [
    "BudgetError",
    "ClusterEstError",
    "ConfigError",
    "DataError",
    "EffectError",
    "ExecutorError",
    "ModelError",
    "ProblemError",
    "RunFolderError",
    "UnsuitableExecutorError",
    "UnwritableError",
]


class ConfigError(ClusterEstError):
    """A config file or a key=value argument says something that it cannot say."""


class ProblemError(ClusterEstError):
    """Parameters, experiments and methods do not fit together."""


class RunFolderError(ClusterEstError):
    """A run folder cannot be written or read."""


class UnwritableError(RunFolderError):
    """A file cannot be written: the disk is full, or its folder is gone or read-only."""


class BudgetError(ClusterEstError):
    """The budget was used up before there was a result."""


class ExecutorError(ClusterEstError):
    """There are no workers to be had."""


class UnsuitableExecutorError(ExecutorError):
    """The executor that was chosen must not run this FMU; others can."""
