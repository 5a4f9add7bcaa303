"""What an FMU finds around it in its process: environment variables, and the working folder."""

from __future__ import annotations

import os
from collections.abc import Callable

from workers.errors import ModelError
from workers.fmu.archive import unpack
from workers.messages import Model

READ_AT_START = (
    *("LD_", "DYLD_", "MALLOC_", "GLIBC_", "PYTHON"),
    *("NUMBA_", "OPENBLAS_", "OMP_", "MKL_"),
)
"""How environment variables begin that a process, or a library, reads only when it starts."""


def set_environment_here(model: Model) -> None:
    """Set an FMU's environment variables in this process, which is not the FMU's alone.

    They stay set, for whatever else is in it.

    Raises
    ------
    ModelError
        If one is something else already, or would come too late.
    """
    elsewhere = 'choose executor.name = "processes" or "ray"'
    for name, value in model.environment:
        known = os.environ.get(name)
        if known == value:
            continue
        if known is not None:
            raise ModelError(
                f"model.environment.{name}: must be {value!r}, but in this process, which "
                f"simulates too, it is {known!r} already; {elsewhere}, or unset it before"
            )
        if name.startswith(READ_AT_START):
            raise ModelError(
                f"model.environment.{name}: must be set before a process starts to be heeded, but "
                f"this one, which simulates too, has started; {elsewhere}, or set it before"
            )
    os.environ.update(model.environment)


def enter_working_folder(model: Model) -> None:
    """Make an FMU's working folder that of this process, which must be the FMU's alone.

    Raises
    ------
    ModelError
        If the FMU has no such folder, or cannot be unpacked.
    """
    if not model.working_folder:
        return
    folder = unpack(model.name, model.archive, model.archive_hash) / model.working_folder
    try:
        os.chdir(folder)
    except OSError as error:
        raise ModelError(
            f"model.working_folder: must be a folder in {model.name}, such as "
            f'"resources", but is {model.working_folder!r} ({error.strerror}); look into the FMU, '
            "which is a zip file"
        ) from error


_to_be_told: list[Callable[[], None]] = []


def before_first_instance(call: Callable[[], None]) -> None:
    """Have something called before this process loads an FMU for the first time from now on."""
    _to_be_told.append(call)


def tell_of_first_instance() -> None:
    """Call who is to be told that an FMU is about to be loaded here."""
    while _to_be_told:
        _to_be_told.pop()()
