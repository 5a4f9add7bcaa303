"""Certainty of claims: the package's regression, refitted to claims with a known truth.

Its output is stored in `cluster_est/closed_loop/findings/claims.py`, which explains each figure. It
must be refitted when the search, its library or its gates have changed. The records must include
loops with all forms, with half of them, and without those of the answer (`--subsets 1
--lacking 1`), because a library rarely contains everything that a user's model lacks.

Probabilities are tested on systems that the regression has not seen, because claims of one system
are similar.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize
from scipy.stats import binomtest, rankdata

from closed_loop_benchmark.scoring import Score
from cluster_est.closed_loop.findings.claims import (
    CLAIMED,
    ClaimCalibration,
    ClaimEvidence,
    LikeClaims,
    claim,
    figures,
)

WEIGHTS = ("fewer", "clean", "apart", "chosen")
WEIGHT_PENALTY = 0.1
"""Penalty on the squares of the weights of standardised figures, in -2 log likelihood. It is a
prior with a standard deviation of 3, which keeps weights finite if one figure separates right from
wrong claims. From 0.03 to 3, the Brier score of 306 claims stayed within 0.0001."""
BINS = 5


@dataclass(frozen=True)
class KnownClaim:
    """An effect of a benchmark loop with a known truth.

    Attributes
    ----------
    case, system, tuned
        Its origin, and whether methods may be tuned on that system.
    claimed
        Whether it was claimed; otherwise it is a lead.
    right, place
        Whether it is right in place and law; in place.
    evidence
        Evidence for it.
    """

    case: str
    system: str
    tuned: bool
    effect: str
    claimed: bool
    right: bool
    place: bool
    evidence: ClaimEvidence


def claims_of(scores: Iterable[Score]) -> list[KnownClaim]:
    """Return the claims and leads of records; equal claims of loops on one case count once."""
    names = [field.name for field in fields(ClaimEvidence)]
    found: dict[tuple[object, ...], KnownClaim] = {}
    for score in scores:
        for row in score.claims or ():
            evidence = ClaimEvidence(**{name: row[name] for name in names})
            effect, claimed = row["effect"], row["claimed"]
            key = (score.name, effect, claimed, evidence.effects, f"{evidence.left:.4f}")
            where = score.name, score.system, score.split == "tune"
            marks = claimed, row["right"], row["place"]
            found.setdefault(key, KnownClaim(*where, effect, *marks, evidence))
    return list(found.values())


def fitted(figures_: np.ndarray, right: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit a logistic regression with nonnegative weights; return its intercept and weights.

    Parameters
    ----------
    figures_ : (claims, weights)
        Predictors.
    right : (claims,)
        Whether each claim is right.
    """
    mean, spread = figures_.mean(axis=0), np.maximum(figures_.std(axis=0), 1e-9)
    scaled, sign = (figures_ - mean) / spread, np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        odds = w[0] + scaled @ w[1:]
        return float(
            2.0 * np.sum(np.logaddexp(0.0, -sign * odds)) + WEIGHT_PENALTY * np.sum(w[1:] ** 2)
        )

    bounds = [(None, None), *[(0.0, None)] * figures_.shape[1]]
    best = minimize(cost, np.zeros(1 + figures_.shape[1]), bounds=bounds).x
    weights = best[1:] / spread
    return float(best[0] - weights @ mean), weights


def calibrated(claims: Sequence[KnownClaim]) -> ClaimCalibration:
    """Fit the regression to the claims of laws, and count the right claims of each kind."""
    laws = _laws(claims)
    curves = [each for each in claims if each.claimed and each.evidence.free]
    leads = [each for each in claims if not each.claimed]
    table, right = _table(laws)
    intercept, weights = fitted(table, right)
    probability = np.zeros(len(laws))
    for own in _systems(laws):
        other, slopes = fitted(table[~own], right[~own])
        probability[own] = 1.0 / (1.0 + np.exp(-(other + table[own] @ slopes)))
    return ClaimCalibration(
        origin=f"{_counted(laws)}, {len(curves)} free curves, {len(leads)} leads",
        intercept=_short(intercept),
        **{name: _short(w) for name, w in zip(WEIGHTS, weights.tolist(), strict=True)},
        alike=_rising(_bins(probability, right)),
        doubtful=_right_of([each.right for each in laws if each.evidence.doubtful]),
        curves=_right_of([each.place for each in curves]),
        leads=_right_of([each.right for each in leads]),
        lead_places=_right_of([each.place for each in leads]),
    )


def left_out(laws: Sequence[KnownClaim]) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities of claims of laws from the claims of all other systems.

    Returns
    -------
    probabilities, base rates : (claims,)
    """
    found, base = np.zeros(len(laws)), np.zeros(len(laws))
    for own in _systems(laws):
        others = [each for each, mine in zip(laws, own, strict=True) if not mine]
        known = calibrated(others)
        base[own] = np.mean([each.right for each in others])
        for i in np.flatnonzero(own).tolist():
            found[i] = claim(laws[i].evidence, known).probability
    return found, base


def _laws(claims: Sequence[KnownClaim]) -> list[KnownClaim]:
    return [each for each in claims if each.claimed and not each.evidence.free]


def _table(laws: Sequence[KnownClaim]) -> tuple[np.ndarray, np.ndarray]:
    """Return the predictors of claims, and whether each claim is right."""
    return np.array([figures(e.evidence) for e in laws]), np.array([e.right for e in laws])


def _systems(laws: Sequence[KnownClaim]) -> Iterator[np.ndarray]:
    """Yield the claims of each system as a mask."""
    systems = np.array([each.system for each in laws])
    return (systems == system for system in dict.fromkeys(systems.tolist()))


def _rising(bins: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[LikeClaims, ...]:
    """Count the claims in bins, and join bins until the share of right claims increases."""
    joined: list[LikeClaims] = []
    for probability, right in bins:
        new = LikeClaims(_short(probability.min()), int(right.sum()), len(right))
        while joined and new.right * joined[-1].of < joined[-1].right * new.of:
            old = joined.pop()
            new = LikeClaims(old.least, old.right + new.right, old.of + new.of)
        joined.append(new)
    return tuple(joined)


def _right_of(right: Collection[bool]) -> LikeClaims:
    return LikeClaims(0.0, sum(right), len(right))


def _counted(claims: Sequence[KnownClaim]) -> str:
    wrong = sum(not each.right for each in claims)
    cases = len({each.case for each in claims})
    systems = len({each.system for each in claims})
    return f"{len(claims)} claims in {cases} cases of {systems} systems, {wrong} of them wrong"


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _bins(probability: np.ndarray, right: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Divide claims into bins of equal size, the least probable first."""
    order = np.argsort(probability, kind="stable")
    return [(probability[rows], right[rows]) for rows in np.array_split(order, BINS)]


def area_under_curve(probability: np.ndarray, right: np.ndarray) -> float:
    """Return how often a right claim has a higher probability than a wrong one."""
    ranks, positive = rankdata(probability), int(right.sum())
    above = ranks[right].sum() - positive * (positive + 1) / 2
    return float(above / max(positive * (len(right) - positive), 1))


def calibration_report(claims: Sequence[KnownClaim]) -> str:
    """Return a comparison of probabilities with the truth, and the data for the package."""
    laws = _laws(claims)
    _, right = _table(laws)
    probability, base = left_out(laws)
    brier, of_base = (float(np.mean((p - right) ** 2)) for p in (probability, base))
    lines = [
        f"{_counted(laws)}; probabilities follow from the other systems",
        f"Brier score {brier:.4f}, that of the base rate {of_base:.4f}; "
        f"area under the curve {area_under_curve(probability, right):.3f}",
        "said            mean   right        95 % interval",
    ]
    for p, r in _bins(probability, right):
        lines.append(f"{p.min():.3f} to {p.max():.3f}  {p.mean():.3f}  {_share(r, p.mean())}")
    parts = {
        "0.9 or more    ": probability >= 0.9,
        "claimed        ": probability >= CLAIMED,
        "leads          ": probability < CLAIMED,
        "never tuned on ": np.array([not each.tuned for each in laws]),
    }
    for name, rows in parts.items():
        if rows.any():
            mean = probability[rows].mean()
            lines.append(f"{name} {mean:.3f}  {_share(right[rows], mean)}")
    lines += ["", f"CALIBRATION = {calibrated(claims)!r}"]
    return "\n".join(lines)


def _share(right: np.ndarray, said: float) -> str:
    """Return a share with its Clopper-Pearson interval, and whether it contains the prediction."""
    low, high = binomtest(int(right.sum()), len(right)).proportion_ci()
    outside = "" if low <= said <= high else "  outside"
    share = f"{right.sum()} of {len(right)}"
    return f"{share:11s} {right.mean():.3f}  {low:.3f} to {high:.3f}{outside}"
