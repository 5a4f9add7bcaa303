"""Requests that are of no use without further points, which a budget may have no room for."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import TypeVar

from cluster_est.methods.base import Evaluation, Points

Returned = TypeVar("Returned")


class BudgetTooShortError(Exception):
    """A budget has no room for points and those that must follow them; see `Points.follow_up`.

    It is raised in a search, which catches it, and goes on with fewer points or ends.
    """


def within_budget(
    requests: Generator[Points, list[Evaluation], Returned], follow_up: int
) -> Generator[Points, list[Evaluation], Returned | None]:
    """Make requests that are of no use without some further points.

    Returns what they return; None where a budget has no room for one of them and the points that
    must follow.
    """
    answers: list[Evaluation] | None = None
    while True:
        try:
            points = next(requests) if answers is None else requests.send(answers)
        except StopIteration as end:
            returned: Returned = end.value
            return returned
        try:
            answers = yield replace(points, follow_up=follow_up)
        except BudgetTooShortError:
            requests.close()
            return None
