"""Processes that descend from this one, as Linux knows them."""

from __future__ import annotations

import os
from pathlib import Path


def ray_actors() -> list[int]:
    """Ray's actor processes."""
    found, parents = [], {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                name = (entry / "cmdline").read_bytes()
                parents[int(entry.name)] = int(
                    (entry / "stat").read_text().rpartition(")")[2].split()[1]
                )
            except OSError:
                continue
            if name.startswith(b"ray::FmuActor"):
                found.append(int(entry.name))
    return [process for process in found if os.getpid() in _ancestors(process, parents)]


def _ancestors(process: int, parents: dict[int, int]) -> set[int]:
    known: set[int] = set()
    while process in parents:
        process = parents[process]
        known.add(process)
    return known
