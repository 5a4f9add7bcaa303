"""The root of all exceptions of this project, and those that a worker can raise."""

from __future__ import annotations


class ClusterEstError(Exception):
    """What a user can correct. Its text says where, what it must be, what it is, what to do."""


class DataError(ClusterEstError):
    """A measured table or signal cannot be read or holds something that is no measurement."""


class ModelError(ClusterEstError):
    """The FMU cannot be read, unpacked, loaded or run, or does not have what was asked of it."""


class EffectError(ClusterEstError):
    """An effect that cannot be: an unknown form, a site that the FMU lacks, no equation."""
