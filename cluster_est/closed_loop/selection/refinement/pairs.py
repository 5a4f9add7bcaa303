"""Two effects at once, for when no single one explains the residual.

The best pairs of directions are found by linear algebra alone: for two unit directions b, c with
g = b'c and the residual's shares x = b'r, y = c'r, both together carry
(x^2 + y^2 - 2 g x y) / (1 - g^2) of r'r.
"""

from __future__ import annotations

import numpy as np

from cluster_est.closed_loop.screening.ranking import CandidateRanking
from cluster_est.closed_loop.selection.refinement.first_steps import joint_step, values_at
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    successive_halving,
)
from cluster_est.closed_loop.thresholds import PairThresholds, RefinementThresholds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench


def refit_pairs(
    workbench: LoopWorkbench, current: FittedModel, ranking: CandidateRanking, floor: float
) -> list[RefittedCandidate]:
    """Refit the best pairs; the best first. A contender's last two effects are the pair."""
    thresholds = workbench.thresholds
    found = best_pairs(ranking, thresholds.pairs)
    starts = [_start(current, ranking, pair, thresholds.refinement) for pair in found]
    return successive_halving(workbench, current, floor, starts) if starts else []


def best_pairs(
    ranking: CandidateRanking, thresholds: PairThresholds | None = None
) -> list[tuple[int, int]]:
    """Pairs of trials of different candidates by the share of the residual that they carry."""
    thresholds = thresholds or PairThresholds()
    scores = ranking.plain
    usable = [
        i for i in np.argsort(-scores.statistics, kind="stable").tolist()
        if scores.df[i] == 1 and not ranking.trials[i].candidate.form.free
    ][: thresholds.leaders]  # fmt: skip
    if len(usable) < 2:
        return []
    first = scores.offsets[usable]
    basis, shares = scores.bases[:, first], scores.coordinates[first]
    gram = basis.T @ basis
    a, b = np.triu_indices(len(usable), 1)
    g = gram[a, b]
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = (shares[a] ** 2 + shares[b] ** 2 - 2.0 * g * shares[a] * shares[b]) / (1 - g**2)
    carried[np.abs(g) > thresholds.alike] = 0.0
    found: list[tuple[int, int]] = []
    seen: set[frozenset[str]] = set()
    for k in np.argsort(-carried, kind="stable").tolist():
        i, j = usable[a[k]], usable[b[k]]
        names = frozenset(ranking.trials[m].candidate.effect.name for m in (i, j))
        if len(names) < 2 or names in seen or carried[k] <= 0.0:
            continue
        seen.add(names)
        found.append((i, j))
        if len(found) >= thresholds.fitted:
            break
    return found


def _start(
    current: FittedModel,
    ranking: CandidateRanking,
    pair: tuple[int, int],
    thresholds: RefinementThresholds,
) -> FitStart:
    """Both effects, with the strengths of the joint linear step."""
    _, strengths, _ = joint_step(current, ranking, pair)
    start = current.start
    for m, own in zip(pair, strengths, strict=True):
        trial = ranking.trials[m]
        start = start.plus(trial.candidate, values_at(trial, own, thresholds))
    return start
