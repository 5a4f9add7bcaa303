import os
from pathlib import Path

from support.processes_of_fmus import is_below, living


def descendants(generation: int) -> set[int]:
    """The processes that descend from this one by so many steps.

    A program has one template process, 1; that has a fork server for each worker, 2; and each of
    these has the process in which the worker's FMU is, 3.
    """
    parents, found = living(), {os.getpid()}
    for _ in range(generation):
        found = {process for process, parent in parents.items() if parent in found}
    return found


def ray_actors() -> dict[int, int]:
    """Ray's actor processes that descend from this one, each with the process of its node."""
    parents = living()
    own = (process for process in parents if is_below(process, os.getpid(), parents))
    return {process: parents[process] for process in own if _is_actor(process)}


def _is_actor(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().startswith(b"ray::FmuActor")
    except OSError:  # it has ended
        return False
