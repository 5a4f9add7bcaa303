from collections.abc import Callable
from typing import ClassVar

import pytest

from cluster_est.executors import EXECUTORS
from cluster_est.executors.local import LocalExecutor
from workers.messages import Outcome


class Observer:
    """What the workers are asked for.

    Attributes
    ----------
    simulated
        All that has come back.
    calls
        How often it was waited for simulations.
    before
        Called with that number, before each time: it may raise what is to happen then.
    """

    def __init__(self) -> None:
        self.simulated: list[Outcome] = []
        self.calls = 0
        self.before: Callable[[int], None] = lambda call: None

    def disturb(self, call: int, error: BaseException) -> None:
        """Raise an error once, where it is waited for the given time from now, counted from 1."""
        at = self.calls + call

        def fail(number: int) -> None:
            if number == at:
                raise error

        self.before = fail


class ObservedExecutor(LocalExecutor):
    """Has its observer hear of everything."""

    observer: ClassVar[Observer] = Observer()

    def completed(self) -> list[Outcome]:
        self.observer.calls += 1
        self.observer.before(self.observer.calls)
        found = super().completed()
        self.observer.simulated += found
        return found


def observe(monkeypatch: pytest.MonkeyPatch) -> Observer:
    """Put it in the place of the executor "local"."""
    ObservedExecutor.observer = Observer()
    place = f"{ObservedExecutor.__module__}:{ObservedExecutor.__name__}"
    monkeypatch.setitem(EXECUTORS, "local", place)
    return ObservedExecutor.observer
