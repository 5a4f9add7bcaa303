"""Spaces derived from other spaces: another start, a fixed unknown, other experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import KnownPrior, Unknown
from workers.messages import FloatArray


def with_start(space: SearchSpace, x: FloatArray) -> SearchSpace:
    """Return the space with the start x.

    The sizes of noticeable changes are kept, because they come from the user's start values. An
    estimate near 0 does not determine them.
    """
    return _made(space, space.unknowns, space.base, x, np.arange(space.size))


def with_fixed_unknown(space: SearchSpace, i: int, x: FloatArray) -> SearchSpace:
    """Return the space in which unknown i is fixed at its value in x, and the others start at x.

    The prior of the fixed unknown still adds to the cost.
    """
    unknown = space.unknowns[i]
    base = space.base.copy()
    # all experiments whose value is searched, so that their base values stay equal to each other
    for other in space.unknowns:
        if other.column == unknown.column:
            base[list(other.experiments), other.column] = unknown.to_physical(float(x[i]))
    columns = np.delete(np.arange(space.size), i)
    unknowns = tuple(space.unknowns[j] for j in columns)
    known = [replace(k, before=k.before - (k.before > i)) for k in space.known_priors]
    if unknown.prior is not None and unknown.experiments:
        residual = unknown.prior_residual(float(x[i]))
        known.append(KnownPrior(i, unknown.experiments[0], residual))
    fixed = replace(space, known_priors=tuple(sorted(known, key=lambda k: k.before)))
    return _made(fixed, unknowns, base, x, columns)


def resampled(space: SearchSpace, positions: Sequence[int], x: FloatArray) -> SearchSpace:
    """Return the space of some experiments; an experiment may occur several times.

    Copies of an experiment share its unknowns, and each copy counts.
    """
    places: dict[int, list[int]] = {}
    for new, old in enumerate(positions):
        places.setdefault(old, []).append(new)
    unknowns, columns = [], []
    for i, unknown in enumerate(space.unknowns):
        found = sorted(new for old in unknown.experiments for new in places.get(old, []))
        if found:
            unknowns.append(replace(unknown, experiments=tuple(found)))
            columns.append(i)
    chosen = list(positions)
    experiments = tuple(space.experiments[p] for p in chosen)
    made = SearchSpace(space.problem, experiments, tuple(unknowns), space.base[chosen])
    return _started(made, space, x, np.array(columns, dtype=np.intp))


def _made(
    space: SearchSpace,
    unknowns: tuple[Unknown, ...],
    base: FloatArray,
    x: FloatArray,
    columns: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> SearchSpace:
    known = space.known_priors
    made = SearchSpace(space.problem, space.experiments, unknowns, base, known_priors=known)
    return _started(made, space, x, columns)


def _started(
    made: SearchSpace,
    space: SearchSpace,
    x: FloatArray,
    columns: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> SearchSpace:
    """Set the cached start and sizes, which would otherwise come from the unknowns' starts."""
    vars(made)["start"] = np.clip(x[columns], space.lower[columns], space.upper[columns])
    vars(made)["typical"] = space.typical[columns]
    return made
