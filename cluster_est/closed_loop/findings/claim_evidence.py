"""The evidence for each effect of a set, from what a closed loop has compared and fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.claims import ClaimEvidence, claim, lead
from cluster_est.closed_loop.findings.effects import (
    AlternativeEffect,
    ErrorChange,
    NamedEffect,
    comparable,
    largest_error,
    pooled_error,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.problem.display import in_a_row, percent
from workers.effects.kinds import FREE_FAMILIES
from workers.messages import Role

MOST_NAMED = 3
"""Alternatives of a lead that its sentence names."""


def with_claims(
    effects: Sequence[NamedEffect],
    errors: Sequence[ErrorChange],
    structures: Sequence[ComparedStructure],
    *,
    declared: bool,
    claimed: bool,
) -> tuple[NamedEffect, ...]:
    """Give each effect of a set what speaks for it, and how sure it is.

    Parameters
    ----------
    effects
        All effects of the set, in the order in which they were added.
    errors
        Before, and with all effects.
    structures
        All that were compared.
    declared
        The noise is declared. Estimated, it is that of all training experiments: what is left of
        held-out ones is then compared with the training experiment with the largest error, because
        experiments may differ in their noise.
    claimed
        The effects are claimed; else they are leads.

    Returns
    -------
    tuple[NamedEffect, ...]
        As they are where no noise is known.
    """
    known = comparable(errors)
    role: Role = "test" if any(each.role == "test" for each in known) else "train"
    before, after = (pooled_error(known, role, after=a) ** 2 for a in (False, True))
    noisiest = 1.0
    if not declared:
        noisiest = max([1.0, *(e.normalised_after for e in known if e.role == "train")])
    left = np.array([largest_error(known, "train"), largest_error(known, "test") / noisiest])
    if np.isnan(left).all():  # no noise is known that an error could be compared with
        return tuple(effects)
    places = [(effect.site, effect.variables) for effect in effects]
    found = []
    for effect in effects:
        rival, chosen = _beside(effect, structures)
        evidence = ClaimEvidence(
            effects=len(effects),
            shared=places.count((effect.site, effect.variables)) > 1,
            left=float(np.nanmax(left)),
            closed=float((before - after) / max(before - 1.0, 1e-12)),
            rival=rival,
            chosen=chosen,
            at_end=any(each.at_bound for each in effect.coefficients),
            free=effect.family in FREE_FAMILIES,
        )
        found.append(replace(effect, claim=(claim if claimed else lead)(evidence)))
    return tuple(found)


def how_sure(effects: Sequence[NamedEffect], *, claimed: bool) -> str:
    """Say of each effect how sure it is, or that it is a lead; "" where that is not known."""
    known = [(effect.label, effect.claim) for effect in effects if effect.claim is not None]
    if not known:
        return ""
    if not claimed:
        label = " and ".join(label for label, _ in known)
        others = [f"{each.words} at {each.site}" for e in effects for each in elsewhere(e)]
        instead = f"; the data do not distinguish it from {in_a_row(others)}" if others else ""
        return f"{label}: {known[0][1].sentence}{instead}"
    said = [
        f"{label} {percent(own.probability)}{' (its place)' if own.evidence.free else ''}"
        for label, own in known
    ]
    return f"probability that place and kind are right: {in_a_row(said)}"


def elsewhere(effect: NamedEffect) -> list[AlternativeEffect]:
    """Return the best alternative of an effect at each of the nearest few other places."""
    found: dict[str, AlternativeEffect] = {}
    for other in sorted(effect.alternatives, key=lambda each: each.criterion):
        if other.site != effect.site:
            found.setdefault(other.site, other)
    return list(found.values())[:MOST_NAMED]


def _beside(effect: NamedEffect, structures: Sequence[ComparedStructure]) -> tuple[float, float]:
    """Return by how much a structure without an effect is worse, and how often it is chosen."""
    with_it = [row for row in structures if effect.label in row.effects]
    without = [row for row in structures if effect.label not in row.effects]
    best = min((row.criterion for row in with_it), default=np.nan)
    second = min([0.0, *(row.criterion for row in without)])
    rival = min([second - best, *(other.criterion for other in effect.alternatives)])
    chosen = [row.chosen for row in with_it if np.isfinite(row.chosen)]
    return float(rival), float(sum(chosen)) if chosen else np.nan
