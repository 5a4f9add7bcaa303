"""The uncertainty of estimates from derivatives, with directions that the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.linalg import qr

from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty.covariance.noise_covariance import NoiseBasis
from workers.messages import FloatArray
from workers.messages.types import by_content

Kind = Literal["undetermined", "weak", "no effect"]
RATIO_TOLERANCE = 0.02
"""Ratios within this of 1 count as 1 in a sentence."""
NAMED = 1e-3
"""Part of the largest relative change: what moves less is not named."""
MOST_NAMED_CHANGES = 6


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
        Change of each as a part of its estimate, for each 1 of the first; NaN where one is about 0.
    ratio
        Change of the residuals along it, over the changes by each unknown on its own. It contains
        an error of the derivatives, `limit`.
    limit
        A smaller ratio cannot be distinguished from 0.
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
        return (
            f"the data determine {names} only in combination: {how} without changing any residual"
        )
    how = _how(labels, weights, relative, grow="grow", grows="grows")
    return f"the data hardly distinguish {names}: the residuals hardly change if {how}"


def _how(
    labels: Sequence[str], weights: FloatArray, relative: FloatArray, grow: str, grows: str
) -> str:
    """Say how the unknowns move together, with the verb for several and for one of them."""
    if np.all(np.abs(relative - 1.0) <= RATIO_TOLERANCE):
        return f"{'both' if len(labels) == 2 else 'all of them'} {grow} by the same factor"
    if len(labels) == 2 and abs(relative[1] + 1.0) <= RATIO_TOLERANCE:
        return f"{labels[0]} {grows} by the factor by which {labels[1]} falls"
    if len(labels) == 2 and weights[1] > 0.0:
        return f"{labels[0]} and {labels[1]} {grow} in the ratio 1 : {weights[1]:.3g}"
    others = [
        f"{label} {'grows' if weight > 0.0 else 'falls'} by {abs(weight):.3g}"
        for label, weight in zip(
            labels[1:MOST_NAMED_CHANGES], weights[1:MOST_NAMED_CHANGES], strict=False
        )
    ]
    return f"{labels[0]} {grows} by 1 while {joined(others)}"


def joined(words: Sequence[str]) -> str:
    """Return words as a sentence lists them, only so many of them."""
    words = list(words)
    if len(words) > MOST_NAMED_CHANGES:
        words = [*words[: MOST_NAMED_CHANGES - 1], f"{len(words) - MOST_NAMED_CHANGES + 1} others"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


@dataclass(frozen=True)
class ConfidenceInterval:
    """Of one unknown, in physical units; NaN where it is held or the data do not determine it.

    Attributes
    ----------
    std_error, lower95, upper95
        By what `Uncertainty.basis` says of the noise.
    at_bound
        "lower" or "upper" where a bound holds it.
    error_white, error_autoregression, error_experiments
        The standard error if the noise is white, if it is an autoregression, and from the scatter
        of the experiments; NaN for what was not taken into account.
    error_uniform
        What `error_white` would be if priors scattered as the measurements do: the curvature of the
        cost alone says it. NaN where there are no priors.
    """

    std_error: float
    lower95: float
    upper95: float
    at_bound: str
    error_white: float = np.nan
    error_autoregression: float = np.nan
    error_experiments: float = np.nan
    error_uniform: float = np.nan


@dataclass(frozen=True)
class DerivedInterval:
    """Of a parameter that follows from others, to first order."""

    label: str
    value: float
    std_error: float
    lower95: float
    upper95: float


@by_content
@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of a solution, to first order.

    Attributes
    ----------
    intervals
        One for each unknown, in their order.
    derived
        Of parameters that follow from others.
    shared, local
        Labels of the free unknowns that several experiments may depend on, and of the others.
    correlations : (shared, shared)
        NaN where the data do not determine one of the two.
    local_correlations : (local, shared)
        Correlations of two local unknowns are left out: their number grows as the square of the
        experiments'.
    directions
        That the data do not determine, or hardly.
    variance, degrees
        s^2 in units of the cost's own weights, and n - k; NaN where there is no covariance.
    basis, basis_degrees
        What the standard errors and intervals take for the noise, and their degrees of freedom.
    notes
        Sentences on omissions, and their reasons.
    """

    intervals: tuple[ConfidenceInterval, ...]
    derived: tuple[DerivedInterval, ...]
    shared: tuple[str, ...]
    local: tuple[str, ...]
    correlations: FloatArray = field(repr=False)
    local_correlations: FloatArray = field(repr=False)
    directions: tuple[UndeterminedDirection, ...]
    variance: float
    degrees: int
    notes: tuple[str, ...]
    basis: NoiseBasis = NoiseBasis.WHITE
    basis_degrees: float = np.nan

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on directions that the data do not determine, and the notes."""
        return (*(direction.sentence for direction in self.directions), *self.notes)
