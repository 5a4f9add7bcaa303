"""Libraries that call back, as generators: SciPy asks for a value and waits, a method yields.

The library runs in a thread of its own that is awake only while the generator is being advanced,
so nothing of it depends on timing.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator
from typing import TypeVar

from cluster_est.methods.base import Evaluation, Points, Search, Solution

Ask = Callable[[Points], list[Evaluation]]
T = TypeVar("T")


class SearchAbandoned(BaseException):
    """Raised inside the library's thread when the search is closed."""


def search_in_thread(solve: Callable[[Ask], Solution]) -> Search:
    """Run `solve(ask)` in a thread and pass on what it asks for.

    Parameters
    ----------
    solve
        Calls the library. `ask(points)` blocks until their evaluations are there.
    """
    asked: queue.SimpleQueue[Points | Solution | BaseException] = queue.SimpleQueue()
    answered: queue.SimpleQueue[list[Evaluation] | None] = queue.SimpleQueue()

    def ask(points: Points) -> list[Evaluation]:
        asked.put(points)
        evaluations = answered.get()
        if evaluations is None:
            raise SearchAbandoned
        return evaluations

    def run() -> None:
        try:
            asked.put(solve(ask))
        except SearchAbandoned:
            pass
        except BaseException as error:  # handed to the coordinator's thread
            asked.put(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while True:
            item = asked.get()
            if isinstance(item, Solution):
                return item
            if isinstance(item, BaseException):
                raise item
            answered.put((yield item))
    finally:
        answered.put(None)
        thread.join()


def drive(steps: Generator[Points, list[Evaluation], T], ask: Ask) -> T:
    """Run a generator to its end by asking directly, to use one of ours inside a library's call."""
    try:
        points = next(steps)
        while True:
            points = steps.send(ask(points))
    except StopIteration as end:
        result: T = end.value
        return result
