"""Checks of an evaluation: whether its values are defined, and its worst constraint."""

from __future__ import annotations

import numpy as np

from cluster_est.methods.base import Ending, Evaluation
from cluster_est.problem.search_space.space import SearchSpace

CUT_SHORT = (
    f"{Ending.STALLED}: the steps became too short because simulations at the end of longer ones "
    "failed"
)
"""The message of a search that ends there."""


def is_defined(at: Evaluation) -> bool:
    """Return whether an evaluation has a cost and a value of every constraint."""
    return at.ok and not np.isnan(at.cost) and not bool(np.isnan(at.constraints).any())


def undefined_reason(at: Evaluation) -> str:
    """Return why the values of an evaluation are not defined, for a message."""
    return at.reason or "the cost or a constraint has no value there"


def worst_constraint(space: SearchSpace, at: Evaluation) -> str:
    """Return a sentence on the constraint that is violated most, and by how much."""
    values = at.constraints
    if not len(values):
        return ""
    sizes = np.where(space.equality, np.abs(values), np.maximum(values, 0.0))
    worst = int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes)))
    name = space.constraint_names[worst]
    return f"the constraint {name!r} is violated most, by {sizes[worst]:.3g} of its scale"
