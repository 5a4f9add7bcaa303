"""Adapt libraries that call a function back to searches, which are generators.

The library runs in its own thread. The thread runs only while the generator is advanced, so the
result does not depend on timing.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator

from cluster_est.methods.method import Evaluation, Points, RequestResult, Search, Solution

Ask = Callable[[Points], list[Evaluation]]
MOST_SCIPY_RUNS = 5
"""Largest number of runs of SciPy in one search; an unknown derivative requires a new run."""


class SearchAbandoned(BaseException):
    """Raised in the library's thread to unwind its stack after the search is closed.

    It is not an `Exception`, because libraries catch exceptions.
    """


def search_in_thread(solve: Callable[[Ask], Solution]) -> Search:
    """Run `solve(ask)` in a thread and yield the points that it requests.

    Parameters
    ----------
    solve
        Function that calls the library. `ask(points)` blocks until it can return the evaluations.
    """
    requested: queue.SimpleQueue[Points | Solution | BaseException] = queue.SimpleQueue()
    answered: queue.SimpleQueue[list[Evaluation] | None] = queue.SimpleQueue()

    def ask(points: Points) -> list[Evaluation]:
        requested.put(points)
        evaluations = answered.get()
        if evaluations is None:
            raise SearchAbandoned
        return evaluations

    def run() -> None:
        try:
            requested.put(solve(ask))
        except SearchAbandoned:
            pass
        except BaseException as error:  # the generator raises it again, and does not wait for ever
            requested.put(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while True:
            item = requested.get()
            if isinstance(item, Solution):
                return item
            if isinstance(item, BaseException):
                raise item
            answered.put((yield item))
    finally:
        answered.put(None)
        thread.join()


def run_with(
    requests: Generator[Points, list[Evaluation], RequestResult], ask: Ask
) -> RequestResult:
    """Return the result of a generator of requests; `ask` evaluates the points."""
    try:
        points = next(requests)
        while True:
            points = requests.send(ask(points))
    except StopIteration as end:
        result: RequestResult = end.value
        return result
