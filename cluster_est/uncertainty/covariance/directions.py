"""Sentences on directions that the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import qr

from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

Kind = Literal["undetermined", "weak", "no effect"]
SAME = 0.02
"""Ratios within this of 1 count as 1 in a sentence."""
NAMED = 1e-3
"""Of the largest relative change: what moves less is not named."""
MOST_NAMED = 6


@dataclass(frozen=True)
class UndeterminedDirection:
    """Unknowns that the data determine only together, or not at all.

    Attributes
    ----------
    labels
        Of the unknowns, in their order.
    weights
        Change of each, in its own unit, for each 1 of the first.
    relative
        The same as parts of the estimates, for each 1 of the first; NaN where one is about 0.
    ratio
        Change of the residuals along it, over the changes by each unknown on its own. It contains
        an error of the derivatives, `limit`.
    limit
        A smaller ratio cannot be told from 0.
    kind
        "undetermined", "weak" (not much above the limit) or "no effect" (of one unknown).
    sentence
        For a person.
    """

    labels: tuple[str, ...]
    weights: tuple[float, ...]
    relative: tuple[float, ...]
    ratio: float
    limit: float
    kind: Kind
    sentence: str


def sparse_basis(vectors: FloatArray, tolerance: float) -> FloatArray:
    """Return (k, unknowns): vectors of the same span, each with few unknowns.

    Several undetermined directions come out of a decomposition mixed. Each vector here has one
    unknown to itself.
    """
    if not len(vectors):
        return vectors
    _, triangle, order = qr(vectors, mode="economic", pivoting=True)
    count = len(vectors)
    reduced = np.linalg.solve(triangle[:, :count], triangle)
    basis = np.zeros_like(vectors)
    basis[:, order] = reduced
    return np.where(np.abs(basis) > tolerance, basis, 0.0)


def direction(
    space: SearchSpace,
    x: FloatArray,
    move: FloatArray,
    ratio: float,
    limit: float,
    *,
    undetermined: bool,
) -> UndeterminedDirection:
    """Describe a direction.

    Parameters
    ----------
    space, x
        The space and the point.
    move : (unknowns,)
        The direction in search coordinates.
    ratio, limit
        See `UndeterminedDirection`.
    undetermined
        True if the data do not determine it at all.
    """
    values = np.array(list(space.estimates(x).values()))
    shift = np.where(space.logarithmic, values * move, move)
    sizes = np.where(np.abs(values) > 1e-3 * space.typical, np.abs(values), space.typical)
    sizes = np.where(space.logarithmic, np.abs(values), sizes)
    parts = np.abs(shift) / sizes
    chosen = np.flatnonzero(parts > NAMED * parts.max())
    shift, values = shift[chosen], values[chosen]
    weights = shift / shift[0]
    about_zero = np.abs(values) < sizes[chosen]
    relative = np.where(about_zero, np.nan, weights / np.where(about_zero, 1.0, values))
    relative = relative / relative[0]
    labels = tuple(space.unknowns[i].label for i in chosen)
    kind: Kind = "undetermined" if undetermined else "weak"
    if undetermined and len(labels) == 1:
        kind = "no effect"
    text = _sentence(labels, weights, relative, kind)
    pair = tuple(weights.tolist()), tuple(relative.tolist())
    return UndeterminedDirection(labels, *pair, float(ratio), float(limit), kind, text)


def _sentence(labels: Sequence[str], weights: FloatArray, relative: FloatArray, kind: Kind) -> str:
    if kind == "no effect":
        return f"{labels[0]} has no effect on any residual"
    if len(labels) == 1:
        return f"{labels[0]} has hardly any effect on the residuals"
    names = joined(labels)
    if kind == "undetermined":
        how = _how(labels, weights, relative, grow="can grow", grows="can grow")
        return f"the data determine {names} only together: {how} without changing any residual"
    how = _how(labels, weights, relative, grow="grow", grows="grows")
    return f"the data hardly tell {names} apart: the residuals hardly change where {how}"


def _how(
    labels: Sequence[str], weights: FloatArray, relative: FloatArray, grow: str, grows: str
) -> str:
    """Say how the unknowns move together, with the verb for several and for one of them."""
    if np.all(np.abs(relative - 1.0) <= SAME):
        return f"{'both' if len(labels) == 2 else 'all of them'} {grow} by the same factor"
    if len(labels) == 2 and abs(relative[1] + 1.0) <= SAME:
        return f"{labels[0]} {grows} by the factor by which {labels[1]} falls"
    if len(labels) == 2 and weights[1] > 0.0:
        return f"{labels[0]} and {labels[1]} {grow} in the ratio 1 : {weights[1]:.3g}"
    others = [
        f"{label} {'grows' if weight > 0.0 else 'falls'} by {abs(weight):.3g}"
        for label, weight in zip(labels[1:MOST_NAMED], weights[1:MOST_NAMED], strict=False)
    ]
    return f"{labels[0]} {grows} by 1 while {joined(others)}"


def joined(words: Sequence[str]) -> str:
    """Return words as a sentence lists them, only so many of them."""
    words = list(words)
    if len(words) > MOST_NAMED:
        words = [*words[: MOST_NAMED - 1], f"{len(words) - MOST_NAMED + 1} others"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
