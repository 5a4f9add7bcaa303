"""The uncertainty of estimates from derivatives, and directions that the data do not determine."""

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
"""Distance from 1 up to which a ratio counts as 1 in a sentence."""
NAMED = 1e-3
"""Share of the largest relative change; unknowns that change less are not named."""
MOST_NAMED_CHANGES = 6
MORE_SAMPLES = "; more samples make the intervals narrower"
"""End of a note on wide intervals."""


@dataclass(frozen=True)
class UndeterminedDirection:
    """Unknowns of which the data determine only a combination, or nothing.

    Attributes
    ----------
    labels
        Labels of the unknowns, in the order of the search space.
    weights
        Change of each unknown, in its own unit, if the first one changes by 1.
    relative
        Change of each unknown relative to its estimate, if the first one changes by 1; NaN for an
        estimate of about 0.
    ratio
        Change of the residuals along the direction, over the changes by each single unknown. It
        contains an error of the derivatives of about `limit`.
    limit
        Ratio below which the change of the residuals cannot be distinguished from 0.
    kind
        "undetermined", "weak" (not much above the limit) or "no effect" (of one unknown).
    sentence
        Description in words.
    """

    labels: tuple[str, ...]
    weights: tuple[float, ...]
    relative: tuple[float, ...]
    ratio: float
    limit: float
    kind: Kind
    sentence: str


def sparse_basis(vectors: FloatArray, tolerance: float) -> FloatArray:
    """Return vectors with the same span that contain few unknowns each: (k, unknowns).

    A decomposition mixes several undetermined directions. Here, each vector has one unknown that no
    other vector contains.
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
        The search space, and the point.
    move : (unknowns,)
        The direction in search coordinates.
    ratio, limit
        See `UndeterminedDirection`.
    undetermined
        Whether the data do not determine the direction at all.
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
    """Describe how the unknowns change together; `grow` and `grows` are the verb forms."""
    if np.all(np.abs(relative - 1.0) <= RATIO_TOLERANCE):
        return f"{'both' if len(labels) == 2 else 'all of them'} {grow} by the same factor"
    if len(labels) == 2 and abs(relative[1] + 1.0) <= RATIO_TOLERANCE:
        return f"{labels[0]} {grows} by the factor by which {labels[1]} falls"
    if len(labels) == 2 and weights[1] > 0.0:
        return f"{labels[0]} and {labels[1]} {grow} in the ratio 1 : {weights[1]:.3g}"
    in_percent = bool(np.isfinite(relative).all())
    changes, unit = (relative, " %") if in_percent else (weights, "")
    others = [
        f"{label} {'grows' if change > 0.0 else 'falls'} by {abs(change):.3g}{unit}"
        for label, change in zip(
            labels[1:MOST_NAMED_CHANGES], changes[1:MOST_NAMED_CHANGES], strict=False
        )
    ]
    own_units = "" if in_percent else " (each in its own unit)"
    return f"{labels[0]} {grows} by 1{unit} while {joined(others)}{own_units}"


def joined(words: Sequence[str]) -> str:
    """Return words as a list in a sentence, which is cut off if it is long."""
    words = list(words)
    if len(words) > MOST_NAMED_CHANGES:
        words = [*words[: MOST_NAMED_CHANGES - 1], f"{len(words) - MOST_NAMED_CHANGES + 1} others"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


@dataclass(frozen=True)
class ConfidenceInterval:
    """The confidence interval of one unknown, in physical units.

    Values are NaN if the unknown is at a bound, or if the data do not determine it.

    Attributes
    ----------
    std_error, lower95, upper95
        Standard error and 95 % interval, for the noise that `Uncertainty.basis` names.
    at_bound
        "lower" or "upper" if the estimate is at a bound.
    error_white, error_autoregression, error_experiments
        The standard error for white noise, for an autoregression, and from the scatter of the
        experiments; NaN for those that were not computed.
    error_uniform
        The value of `error_white` if the priors scattered like the measurements; it follows from
        the curvature of the cost alone. NaN without priors.
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
    """The interval of a parameter that is computed from others, to first order."""

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
        One interval for each unknown, in the order of the search space.
    derived
        Intervals of parameters that are computed from others.
    shared, local
        Labels of the free unknowns on which several experiments may depend, and of the others.
    correlations : (shared, shared)
        NaN if the data do not determine one of the two unknowns.
    local_correlations : (local, shared)
        Correlations of two local unknowns are left out, because their number grows with the square
        of the number of experiments.
    directions
        Directions that the data do not determine, or determine only weakly.
    variance, degrees
        s^2 in units of the cost's weights, and n - k; NaN if there is no covariance.
    basis, basis_degrees
        The noise model of the standard errors and intervals, and their degrees of freedom.
    notes
        Sentences on omitted results, with reasons.
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
        """Sentences on directions that the data do not determine, followed by the notes."""
        return self.sentences_of(systematic=False)

    def sentences_of(self, *, systematic: bool) -> tuple[str, ...]:
        """Return the `sentences`, without the advice to take more samples if it would not help.

        More samples do not make a systematic error of the model smaller.
        """
        notes = (each.removesuffix(MORE_SAMPLES) if systematic else each for each in self.notes)
        return (*(direction.sentence for direction in self.directions), *notes)
