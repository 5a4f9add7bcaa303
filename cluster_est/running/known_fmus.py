"""The FMUs that this machine knows: they have survived simulations and a reset between them."""

from __future__ import annotations

import contextlib
from pathlib import Path

from workers.fmu.archive import unpacked_folder
from workers.messages import Model


def has_survived(model: Model) -> bool:
    """Return whether this FMU was simulated, reset and simulated again here without a crash."""
    return _mark(model).exists()


def remember_survival(model: Model) -> None:
    """Remember that; where it cannot be written down, the FMU is tried again the next time."""
    with contextlib.suppress(OSError):
        _mark(model).touch()


def _mark(model: Model) -> Path:
    """Return a file beside the unpacked FMU, for its interface and solver."""
    folder = unpacked_folder(model.archive_hash)
    return folder.with_name(f"{folder.name}.survived-{model.interface}-{model.solver.name}")
