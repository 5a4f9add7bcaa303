"""Products of many cases: the default run takes a few that stand for all, the full run each."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import pytest


def thinned(cases: Sequence[Any], *factors: Callable[..., Hashable]) -> list[Any]:
    """Mark cases as slow, except for a few in which each value of each factor occurs.

    A case is a `pytest.param` or a tuple of arguments; a factor gets the case's arguments and gives
    what must occur, for instance the name of a method or a pair of version and interface. Greedy:
    of all cases the one with the most values that did not occur yet, the first of equals. Values
    that occur in slow cases alone need not occur.
    """
    params = [case if hasattr(case, "values") else pytest.param(*case) for case in cases]
    wanted: list[set[tuple[int, Hashable]]] = [
        {(i, factor(*p.values)) for i, factor in enumerate(factors)} if p.marks == () else set()
        for p in params
    ]
    missing = set().union(*wanted)
    kept: set[int] = set()
    while missing:
        best = max(range(len(params)), key=lambda i: len(wanted[i] & missing))
        kept.add(best)
        missing -= wanted[best]
    return [
        p
        if i in kept or p.marks
        else pytest.param(*p.values, marks=[*p.marks, pytest.mark.slow], id=p.id)
        for i, p in enumerate(params)
    ]
