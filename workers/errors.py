"""The root of all exceptions of this project, and the exceptions that a worker can raise."""

from __future__ import annotations


class ClusterEstError(Exception):
    """An error that a user can correct.

    Its message says where it is, what is required, what was found, and what to do.
    """


class DataError(ClusterEstError):
    """A measured table or signal cannot be read, or contains values that are not measurements."""


class ModelError(ClusterEstError):
    """The FMU cannot be read, unpacked, loaded or run, or it lacks a requested feature."""


class EffectError(ClusterEstError):
    """An effect is invalid: an unknown form, a site that the FMU lacks, or not an equation."""
