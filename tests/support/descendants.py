"""Processes that descend from this one, as Linux knows them."""

import os
from pathlib import Path


def descendants(generation: int) -> set[int]:
    """The processes that descend from this one by so many steps.

    A program has one template process, 1; that has a fork server for each worker, 2; and each of
    these has the process in which the worker's FMU is, 3.
    """
    parents, found = _parents(), {os.getpid()}
    for _ in range(generation):
        found = {process for process, parent in parents.items() if parent in found}
    return found


def ray_actors() -> dict[int, int]:
    """Ray's actor processes that descend from this one, each with the process of its node."""
    parents = _parents()
    return {
        process: parents[process]
        for process in parents
        if os.getpid() in _ancestors(process, parents)
        and _name(process).startswith(b"ray::FmuActor")
    }


def _parents() -> dict[int, int]:
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
            except OSError:  # it has ended
                continue
            found[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    return found


def _name(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


def _ancestors(process: int, parents: dict[int, int]) -> set[int]:
    known: set[int] = set()
    while process in parents:
        process = parents[process]
        known.add(process)
    return known
