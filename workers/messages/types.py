"""Types of arrays and of choices by name, equality and hashes by content, progress of a simulation.

Equality is by content for classes with arrays, which NumPy compares number by number. Progress is
noted for whoever waits for a simulation in another process: it says that the simulation goes on,
whatever the clock says.
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
"""Reductions of the residuals r of an output: the root of the sum of r^2, or the sum of
|r|. Of one number, the sum of squares or of absolute values is that of them all."""
USUAL: tuple[Want, ...] = ("residuals", *REDUCTIONS)
"""Wants of searches: the same simulation, of which less or more is sent back."""


def content_hash(parts: Iterable[str | bytes]) -> str:
    """SHA-256 over parts, each preceded by its length so that no two lists collide."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


CALLED, SIMULATIONS, RUNNING, STEPS = range(4)
"""Whether the FMU was told where it is, or to make a step, since somebody looked; how many
simulations have begun; whether one of them is under way; and the steps of the solver in the last
one that reached its end."""


def no_watcher() -> IntArray:
    """Progress that nobody looks at."""
    return np.zeros(4, np.int64)


Class = TypeVar("Class", bound=type)


def by_content(cls: Class) -> Class:
    """Let instances of a dataclass be equal where all that they hold is, arrays bit for bit.

    NaN equals NaN, unlike in Python, so that a copy equals what it is a copy of. Hashes stay as
    they are.
    """

    def equal(self: object, other: object) -> Any:
        if type(other) is not type(self):
            return NotImplemented
        return self is other or _same_fields(self, other)

    cls.__eq__ = equal  # type: ignore[method-assign, assignment]
    return cls


def same_content(one: Any, other: Any) -> bool:
    """Return whether two values are of one class and hold the same.

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
