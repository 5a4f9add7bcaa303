"""Seats of Ray actors, where the number of the FMU's instances is limited.

On one machine a seat is a lock that its process holds (`workers.fmu.seats`). No lock reaches from
one machine to another, so an actor that takes the place of another is started on the node where
that one was: there it waits until the other one's process is gone. If that node is gone, so is
everything on it, and Ray may choose any.
"""

from __future__ import annotations

from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from workers.messages import Seats

_nodes: dict[tuple[str, int], str] = {}
"""The node where each seat was taken last, as long as this program lives: pools follow pools."""


class ActorSeats:
    """The seats of a pool, and which actor has which.

    Parameters
    ----------
    seats
        Of the pool; None where any number of instances may exist.
    """

    def __init__(self, seats: Seats | None) -> None:
        self._seats = seats
        self._free = [] if seats is None else list(range(len(seats.numbers)))
        self._of: dict[str, int] = {}
        self._asked: dict[str, Any] = {}

    def take(self, name: str) -> int:
        """Give a new actor a seat; return its number among the pool's workers."""
        if self._seats is None:
            return 0
        self._of[name] = worker = self._free.pop(0)
        return worker

    def placed(self, worker: int) -> dict[str, Any]:
        """Return the options that an actor with this seat is started with."""
        node = None if self._seats is None else _nodes.get(self._key(worker))
        if node is None:
            return {}
        return {"scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=True)}

    def ask_node(self, name: str, actor: Any) -> None:
        """Ask an actor where it is, before it loads the FMU."""
        if self._seats is not None:
            self._asked[name] = actor.node.remote()

    def leave(self, name: str) -> None:
        """Note that an actor is lost: its seat is for the next one, on the same node."""
        if self._seats is None:
            return
        self._note_node(name)
        self._free.append(self._of.pop(name))
        self._free.sort()

    def close(self) -> None:
        """Note that all actors have ended."""
        for name in list(self._of):
            self.leave(name)

    def first(self, workers: int) -> list[str]:
        """Return the actors that have the first seats."""
        return [name for name, worker in self._of.items() if worker < workers]

    def _note_node(self, name: str) -> None:
        """Remember where an actor was; one that never said so has not loaded anything."""
        reference = self._asked.pop(name)
        ready, _ = ray.wait([reference], timeout=0)
        if not ready:
            return
        try:
            node: str = ray.get(reference)
        except RayError:
            return
        _nodes[self._key(self._of[name])] = node

    def _key(self, worker: int) -> tuple[str, int]:
        assert self._seats is not None
        return self._seats.program, self._seats.numbers[worker]
