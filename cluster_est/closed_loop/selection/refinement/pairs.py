"""Two effects at once, for when no single one explains the residual.

The best pairs of directions are found by linear algebra alone: for two unit directions b, c with
g = b'c and the residual's shares x = b'r, y = c'r, both together carry
(x^2 + y^2 - 2 g x y) / (1 - g^2) of r'r.
"""

from __future__ import annotations

import numpy as np

from cluster_est.closed_loop.screening.ranking import CandidateRanking
from cluster_est.closed_loop.selection.refinement.first_steps import (
    is_proportional,
    joint_step,
    values_at,
)
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    refit_briefly,
    successive_halving,
)
from cluster_est.closed_loop.selection.refinement.useful_fit import (
    UsefulFit,
    may_start_useful,
    shares_left,
)
from cluster_est.closed_loop.thresholds import PairThresholds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench


def refit_pairs(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    useful: UsefulFit,
) -> list[RefittedCandidate]:
    """Refit the best pairs; the best first. A contender's last two effects are the pair.

    Those that the linear model does not let hope to be useful are left out.
    """
    found = best_pairs(ranking, workbench.thresholds.pairs)
    asked = [_start(workbench, current, ranking, pair, useful) for pair in found]
    fits = refit_briefly(workbench, [start for start in asked if start is not None])
    return successive_halving(workbench, current, floor, fits, useful)


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
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    pair: tuple[int, int],
    useful: UsefulFit,
) -> FitStart | None:
    """Both effects, with the strengths of the joint linear step; None if of no use."""
    _, strengths, after = joint_step(current, ranking, pair)
    start = current.start
    for m, own in zip(pair, strengths, strict=True):
        trial = ranking.trials[m]
        values = values_at(trial, own, workbench.thresholds.refinement)
        start = start.plus(trial.candidate, values)
    if all(is_proportional(ranking.trials[m]) for m in pair):
        added = workbench.space(start).size - len(current.x)
        left = shares_left(ranking.records, current.residuals[ranking.rows], after)
        if not may_start_useful(workbench, current, left, added, useful):
            return None
    return start
