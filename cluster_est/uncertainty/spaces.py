"""Spaces made of other spaces: started elsewhere, with an unknown kept, with other experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.problem.space import SearchSpace
from cluster_est.problem.unknown import Unknown
from workers.messages import FloatArray


def moved(space: SearchSpace, x: FloatArray) -> SearchSpace:
    """The same space, from which searches start at x.

    The size of a noticeable change stays what it was: it comes from the start that the user gave,
    and an estimate that happens to be nearly 0 says nothing about it.
    """
    return _made(space, space.unknowns, space.base, x, np.arange(space.size))


def without(space: SearchSpace, i: int, x: FloatArray) -> SearchSpace:
    """The space in which unknown i is kept at its value in x, and the others start there."""
    unknown = space.unknowns[i]
    base = space.base.copy()
    # all experiments whose value is searched, so that their base values stay equal to each other
    for other in space.unknowns:
        if other.column == unknown.column:
            base[list(other.experiments), other.column] = unknown.to_physical(float(x[i]))
    kept = np.delete(np.arange(space.size), i)
    unknowns = tuple(space.unknowns[j] for j in kept)
    return _made(space, unknowns, base, x, kept)


def resampled(space: SearchSpace, positions: Sequence[int], x: FloatArray) -> SearchSpace:
    """The space of some of the experiments, of which one may appear several times.

    Copies of an experiment share its own unknowns, and each counts.
    """
    places: dict[int, list[int]] = {}
    for new, old in enumerate(positions):
        places.setdefault(old, []).append(new)
    unknowns, kept = [], []
    for i, unknown in enumerate(space.unknowns):
        found = sorted(new for old in unknown.experiments for new in places.get(old, []))
        if found:
            unknowns.append(replace(unknown, experiments=tuple(found)))
            kept.append(i)
    chosen = list(positions)
    experiments = tuple(space.experiments[p] for p in chosen)
    made = SearchSpace(space.problem, experiments, tuple(unknowns), space.base[chosen])
    return _started(made, space, x, np.array(kept, dtype=np.intp))


def _made(
    space: SearchSpace,
    unknowns: tuple[Unknown, ...],
    base: FloatArray,
    x: FloatArray,
    kept: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> SearchSpace:
    made = SearchSpace(space.problem, space.experiments, unknowns, base)
    return _started(made, space, x, kept)


def _started(
    made: SearchSpace,
    space: SearchSpace,
    x: FloatArray,
    kept: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> SearchSpace:
    """Both are cached properties that would follow from the unknowns' own starts."""
    vars(made)["start"] = np.clip(x[kept], space.lower[kept], space.upper[kept])
    vars(made)["typical"] = space.typical[kept]
    return made
