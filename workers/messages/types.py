"""Types of arrays and of choices by name, hashes of contents, and the progress of a simulation.

Progress is noted for whoever waits for a simulation in another process: it says that the simulation
goes on, whatever the clock says.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[Any]
Interface = Literal["model_exchange", "co_simulation"]
SolverName = Literal["dormand_prince", "rk4", "cvode", "fmu"]
Interpolation = Literal["linear", "hold"]
Role = Literal["train", "test"]
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
