"""How sure a claimed effect is: the evidence of its claim, and the probability that it is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.findings.effects import (
    ErrorChange,
    NamedEffect,
    comparable,
    largest_error,
    pooled_error,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from workers.effects.kinds import FREE_FAMILY
from workers.messages import Role


@dataclass(frozen=True)
class ClaimEvidence:
    """What speaks for an effect that is claimed.

    Attributes
    ----------
    effects
        How many effects are claimed with it.
    left
        The largest error of an output that is left, over the noise: of training or held-out data.
    closed
        Share of the gap between the squares of error and noise that all effects close, on held-out
        data where there are some, else on those of training.
    rival
        Criterion of the best structure without an effect of this form at this site, less that of
        the best with it; infinite where every structure that was refitted has it.
    own
        Share of the gap that the best structure without it leaves, and that with it closes.
    chosen
        Share of the resamplings of the experiments whose best structure has it; NaN if not known.
    better
        Share of the records whose error falls with all effects.
    free
        It is a free curve.
    """

    effects: int
    left: float
    closed: float
    rival: float
    own: float
    chosen: float
    better: float
    free: bool


def claim_evidence(
    effects: Sequence[NamedEffect],
    errors: Sequence[ErrorChange],
    structures: Sequence[ComparedStructure],
) -> tuple[ClaimEvidence, ...]:
    """Return the evidence of each claimed effect, from what a closed loop reports."""
    known = comparable(errors)
    role: Role = "test" if any(each.role == "test" for each in known) else "train"
    before, after = (pooled_error(known, role, after=a) ** 2 for a in (False, True))
    left = np.nanmax([largest_error(known, "train"), largest_error(known, "test"), 1.0])
    better = [each.normalised_after < each.normalised_before for each in known]
    found = []
    for effect in effects:
        with_it = [row for row in structures if any(_is(effect, own) for own in row.effects)]
        without = [row for row in structures if row not in with_it]
        best = min((row.criterion for row in with_it), default=np.nan)
        second = min((row.criterion for row in without), default=0.0)
        others = [a.criterion for a in effect.alternatives]
        rival = min([min(second, 0.0) - best, *others])
        share = max((row.closed for row in with_it), default=np.nan)
        other = max((row.closed for row in without), default=0.0)
        chosen = [row.chosen for row in with_it if np.isfinite(row.chosen)]
        found.append(
            ClaimEvidence(
                effects=len(effects),
                left=float(left),
                closed=float((before - after) / max(before - 1.0, 1e-12)),
                better=float(np.mean(better)) if better else np.nan,
                rival=float(rival),
                own=float(share - max(other, 0.0)),
                chosen=float(sum(chosen)) if chosen else np.nan,
                free=effect.family == FREE_FAMILY,
            )
        )
    return tuple(found)


def _is(effect: NamedEffect, label: str) -> bool:
    """Return whether a label of a structure is that of an effect's form at its site."""
    called, _, site = label.partition(" at ")
    return site == effect.site and called.partition("(")[0] == effect.form
