"""Two effects at once, for when no single one explains the residual.

The best pairs of directions are found by linear algebra alone: for two unit directions b, c with
g = b'c and the residual's shares x = b'r, y = c'r, both together carry
(x^2 + y^2 - 2 g x y) / (1 - g^2) of r'r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import CandidateRanking
from cluster_est.closed_loop.selection.linear_model import (
    PruningBound,
    can_reach_with,
    is_proportional,
    joint_step,
    shares_left,
    values_at,
)
from cluster_est.closed_loop.selection.refits import (
    RefittedCandidate,
    proposed_by,
    refit_briefly,
    successive_halving,
)
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.settings import LoopPart


@dataclass(frozen=True)
class PairThresholds:
    """Thresholds of the search for two effects at once.

    Attributes
    ----------
    leaders
        Directions that are paired. Benchmark; the work grows with its square.
    alike
        Cosine above which two directions are no pair. Benchmark.
    fitted
        Pairs that are refitted. Benchmark.
    """

    leaders: int = 90
    alike: float = 0.98
    fitted: int = 8


PAIRS = PairThresholds()


def refit_pairs(fitter: Fitter, begun: RoundStart, bound: PruningBound) -> list[RefittedCandidate]:
    """Refit the best pairs; the best first. A contender's last two effects are the pair.

    Those that the linear model does not let hope to be useful are left out.
    """
    current, ranking = begun.model, begun.screening.ranking
    asked = [_start_of_pair(fitter, current, ranking, p, bound) for p in best_pairs(ranking)]
    fits = refit_briefly(fitter, [start for start in asked if start is not None])
    found = successive_halving(fitter, current, begun.floor, fits, bound)
    return proposed_by(LoopPart.ADD_TWO, found)


def best_pairs(ranking: CandidateRanking, most: int = PAIRS.fitted) -> list[tuple[int, int]]:
    """Pairs of trials of different candidates by the share of the residual that they carry."""
    scores = ranking.plain
    usable = [
        i for i in np.argsort(-scores.statistics, kind="stable").tolist()
        if scores.df[i] == 1 and not ranking.trials[i].candidate.form.free
    ][: PAIRS.leaders]  # fmt: skip
    if len(usable) < 2:
        return []
    first = scores.offsets[usable]
    basis, shares = scores.bases[:, first], scores.coordinates[first]
    gram = basis.T @ basis
    a, b = np.triu_indices(len(usable), 1)
    g = gram[a, b]
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = (shares[a] ** 2 + shares[b] ** 2 - 2.0 * g * shares[a] * shares[b]) / (1 - g**2)
    carried[np.abs(g) > PAIRS.alike] = 0.0
    found: list[tuple[int, int]] = []
    seen: set[frozenset[str]] = set()
    for k in np.argsort(-carried, kind="stable").tolist():
        i, j = usable[a[k]], usable[b[k]]
        names = frozenset(ranking.trials[m].candidate.effect.name for m in (i, j))
        if len(names) < 2 or names in seen or carried[k] <= 0.0:
            continue
        seen.add(names)
        found.append((i, j))
        if len(found) >= most:
            break
    return found


def _start_of_pair(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    pair: tuple[int, int],
    bound: PruningBound,
) -> FitStart | None:
    """Both effects, with the strengths of the joint linear step; None if of no use."""
    _, strengths, after = joint_step(current, ranking, pair)
    start = current.start
    for m, own in zip(pair, strengths, strict=True):
        trial = ranking.trials[m]
        start = start.plus(trial.candidate, values_at(trial, own))
    if all(is_proportional(ranking.trials[m]) for m in pair):
        added = fitter.space(start).size - len(current.x)
        left = shares_left(ranking.records, current.residuals[ranking.rows], after)
        if not can_reach_with(fitter.records, current, left, added, bound):
            return None
    return start
