"""Adapt libraries that call a function back to searches, which are generators.

The library runs in a thread of its own that is awake only while the generator is being advanced,
so nothing depends on timing.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator

from cluster_est.methods.method import Evaluation, Points, RequestResult, Search, Solution

Ask = Callable[[Points], list[Evaluation]]
MOST_SCIPY_RUNS = 5
"""Runs of SciPy in one search, of which each but the last met a derivative that was not known."""
FAILED_TRIALS_IN_A_ROW = 3
"""Trial points that failed in a row, after which a short step says nothing of a minimum."""


class SearchAbandoned(BaseException):
    """Raised in the library's thread once its search is closed, to unwind the library's stack.

    Not an `Exception`, because libraries catch those.
    """


def search_in_thread(solve: Callable[[Ask], Solution]) -> Search:
    """Run `solve(ask)` in a thread and yield the points that it asks for.

    Parameters
    ----------
    solve
        Calls the library. `ask(points)` blocks until their evaluations are there.
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
        except BaseException as error:  # raised again by the generator, which would wait for ever
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
    """Return the result of a generator of requests that is answered by `ask` in a callback."""
    try:
        points = next(requests)
        while True:
            points = requests.send(ask(points))
    except StopIteration as end:
        result: RequestResult = end.value
        return result
