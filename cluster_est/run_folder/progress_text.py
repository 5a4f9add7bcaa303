"""What is done now, how much of it is done, and the time left, in words."""

from __future__ import annotations

import math

from cluster_est.closed_loop.stages import stage_title

FIT_TITLES = {
    "models": "fitting",
    "candidates": "simulating inputs",
    "refits": "fitting rivals to what each model predicts",
    "before": "simulating at the start values",
    "sample": "simulating between the bounds",
    "train": "searching",
    "screen": "screening the starts",
    "starts": "evaluating the starts",
    "derivatives": "finding the intervals",
    "directions": "finding the intervals",
    "test": "fitting the test records",
    "after": "simulating at the estimates",
}
"""Texts for people, by the names of the searches of a fit or a sensitivity analysis in the log."""


LEAST_PACE = 1.0
"""Seconds of an iteration: nobody waits for a shorter one."""


def search_title(search: str) -> str:
    """Return what a person reads of a search, by its name in the log."""
    return FIT_TITLES.get(search) or stage_title(search)


def what_is_done(search: str, phase: str, ended: int, searches: int) -> str:
    """Return what a run does now, and how many of the searches begun together have ended."""
    title = search_title(search)
    parts = [f"{phase}: {title}" if phase else title]
    if searches > 1:
        parts.append(f"{ended} of {searches} done")
    return ", ".join(parts)


def pace_of(seconds: float) -> str:
    """Return how long an iteration takes, where it is long enough to be of interest."""
    if not seconds >= LEAST_PACE:
        return ""
    return f"an iteration takes about {_seconds(seconds)}"


def left_of_step(phase: str, seconds: float, *, at_most: bool = True) -> str:
    """Return the time left of what is done now; that of a whole recipe depends on what is found.

    Nothing for what is no recipe of phases, where nobody knows. `at_most` says whether it is a
    limit, or what is to be expected.
    """
    if math.isnan(seconds):
        return "time left unknown" if phase else ""
    return f"this step: {'at most ' if at_most else ''}about {_seconds(seconds)} left"


def _seconds(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
