"""Rows of the tables on uncertainty; each table has one dataclass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cluster_est.uncertainty.bootstrap import BootstrapResult
from cluster_est.uncertainty.covariance.local_uncertainty import Uncertainty
from cluster_est.uncertainty.posterior_draws import PosteriorResult
from cluster_est.uncertainty.profile_points import ProfileResult


@dataclass(frozen=True)
class CorrelationRow:
    """A row of correlations.parquet: a pair of unknowns of which at least one is shared.

    Each pair has one row.
    """

    label: str
    other: str
    correlation: float


@dataclass(frozen=True)
class DirectionRow:
    """A row of directions.parquet: one unknown of the direction with the number `direction`.

    `weight` is the change of the unknown, in its own unit, if the first unknown of the direction
    changes by 1. `relative` is the same for changes relative to the estimates.
    """

    direction: int
    kind: str
    label: str
    weight: float
    relative: float
    ratio: float
    limit: float
    sentence: str


@dataclass(frozen=True)
class ProfileRow:
    """A row of profiles.parquet: one unknown at one point of a profile.

    Rows whose `unknown` is `label` are the profile itself. The other rows contain the refitted
    values of the other unknowns.
    """

    label: str
    point: int
    value: float
    cost: float
    root: float
    unknown: str
    estimate: float


@dataclass(frozen=True)
class BootstrapRow:
    """A row of bootstrap.parquet: one shared unknown in one draw."""

    draw: int
    label: str
    estimate: float
    cost: float
    ending: str
    experiments: str


@dataclass(frozen=True)
class IntervalRow:
    """A row of intervals.parquet: an interval from refits or draws.

    `source` is "profile", "bootstrap", "bootstrap percentile", "bootstrap basic" or "posterior".
    `open_lower` and `open_upper` are the reasons why a profile has no lower or upper end.
    """

    label: str
    source: str
    confidence: float
    value: float
    lower: float
    upper: float
    open_lower: str = ""
    open_upper: str = ""


def correlation_rows(found: Uncertainty) -> list[CorrelationRow]:
    """Return the rows of pairs of shared unknowns, then of local with shared unknowns."""
    rows = [
        CorrelationRow(label, other, float(found.correlations[i, j]))
        for i, label in enumerate(found.shared)
        for j, other in enumerate(found.shared[:i])
    ]
    rows += [
        CorrelationRow(label, other, float(found.local_correlations[i, j]))
        for i, label in enumerate(found.local)
        for j, other in enumerate(found.shared)
    ]
    return rows


def direction_rows(found: Uncertainty) -> list[DirectionRow]:
    """Return one row for each unknown of each direction."""
    return [
        DirectionRow(number, d.kind, *each, d.ratio, d.limit, d.sentence)
        for number, d in enumerate(found.directions)
        for each in zip(d.labels, d.weights, d.relative, strict=True)
    ]


def profile_rows(found: Sequence[ProfileResult]) -> list[ProfileRow]:
    """Return one row for each unknown at each point."""
    return [
        ProfileRow(profile.label, number, p.value, p.cost, p.root, unknown, estimate)
        for profile in found
        for number, p in enumerate(profile.points)
        for unknown, estimate in zip(profile.labels, p.estimates, strict=True)
    ]


def bootstrap_rows(found: BootstrapResult) -> list[BootstrapRow]:
    """Return one row for each shared unknown in each draw."""
    return [
        BootstrapRow(number, label, estimate, d.cost, d.ending, " ".join(d.experiments))
        for number, d in enumerate(found.draws)
        for label, estimate in zip(found.labels, d.estimates, strict=True)
    ]


def interval_rows(
    profiles: Sequence[ProfileResult],
    bootstrap: BootstrapResult | None,
    posterior: PosteriorResult | None = None,
) -> list[IntervalRow]:
    """Return all intervals from refits or draws."""
    rows = [
        IntervalRow(
            p.label,
            "profile",
            p.confidence,
            p.value,
            p.lower,
            p.upper,
            p.open_lower.value,
            p.open_upper.value,
        )
        for p in profiles
    ]
    if posterior is not None:
        level = posterior.confidence
        rows += [
            IntervalRow(each.label, "posterior", level, each.median, each.lower, each.upper)
            for each in posterior.intervals
            if posterior.mixed
        ]
    if bootstrap is None:
        return rows
    level = bootstrap.confidence
    for each in bootstrap.intervals:
        sources = (
            ("bootstrap", each.lower, each.upper),
            ("bootstrap percentile", each.percentile_lower, each.percentile_upper),
            ("bootstrap basic", each.basic_lower, each.basic_upper),
        )
        rows += [IntervalRow(each.label, s, level, each.value, a, b) for s, a, b in sources]
    return rows
