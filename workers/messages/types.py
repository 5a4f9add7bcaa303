"""Types of arrays, named choices, equality and hashes by content, and progress of a simulation.

Equality of classes with arrays is by content, because NumPy compares arrays elementwise. Progress
shows to a waiting process that a simulation continues, independently of the clock.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[Any]
Interface = Literal["model_exchange", "co_simulation"]
SolverName = Literal["dormand_prince", "rk4", "cvode", "fmu"]
Interpolation = Literal["linear", "hold"]
Role = Literal["train", "test"]
GapRule = Literal["split", "bridge"]
Reduction = Literal["squares", "absolutes"]
Want = Literal["residuals", "squares", "absolutes", "trajectory", "linearisation", "sensitivities"]
ResetPolicy = Literal["auto", "reset", "instance", "process"]
Value = float | int | bool | str

REDUCTIONS: tuple[Reduction, ...] = get_args(Reduction)
"""Reductions of the residuals r of an output: the root of the sum of r^2, or the sum of |r|.
Summing the squares or absolute values of reduced residuals gives the sum over all residuals."""
USUAL: tuple[Want, ...] = ("residuals", *REDUCTIONS)
"""Wants of searches, which differ only in the amount of data in the answer."""


def content_hash(parts: Iterable[str | bytes]) -> str:
    """Return the SHA-256 of parts, each preceded by its length to avoid collisions of lists."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


CALLED, SIMULATIONS, RUNNING, STEPS = range(4)
"""Indices of progress: whether a time or a step was passed to the FMU since the last observation;
the number of simulations started; whether one is running; and the solver's steps in the last
simulation that reached its end."""


def no_watcher() -> IntArray:
    """Return progress that no process observes."""
    return np.zeros(4, np.int64)


Class = TypeVar("Class", bound=type)


def by_content(cls: Class) -> Class:
    """Make instances of a dataclass equal if their contents are equal, arrays bit for bit.

    Unlike in Python, NaN equals NaN, so a copy equals its original. Hashes are not changed.
    """

    def equal(self: object, other: object) -> Any:
        if type(other) is not type(self):
            return NotImplemented
        return self is other or _same_fields(self, other)

    cls.__eq__ = equal  # type: ignore[method-assign, assignment]
    return cls


def same_content(one: Any, other: Any) -> bool:
    """Return whether two values have the same class and content.

    Parameters
    ----------
    one, other
        Numbers, texts, arrays, tables, dataclasses, and tuples, lists and mappings of these.
    """
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return _same_array(one, other)
    if isinstance(one, float | np.floating):
        return bool(one == other or (np.isnan(one) and np.isnan(other)))
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same_content, one, other))
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(same_content(one[k], other[k]) for k in one)
    if is_dataclass(one):
        return _same_fields(one, other)
    return bool(one == other)


def _same_fields(one: Any, other: Any) -> bool:
    return all(
        same_content(getattr(one, each.name), getattr(other, each.name))
        for each in fields(one)
        if each.compare
    )


def _same_array(one: np.ndarray[Any, Any], other: np.ndarray[Any, Any]) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if one.dtype.kind == "O":
        return all(map(same_content, one.ravel().tolist(), other.ravel().tolist()))
    if one.tobytes() == other.tobytes():
        return True
    if one.dtype.kind != "f":
        return False
    known = ~np.isnan(one)
    alike = np.array_equal(known, ~np.isnan(other))
    return bool(alike and one[known].tobytes() == other[known].tobytes())
