"""From what segments found to a fit on whole records, where the model can be simulated so."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import Method, Solution
from cluster_est.methods.given_points import GivenPoints
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.results.segments import ShootingSummary
from cluster_est.running.multistart import Multistart, MultistartResult, search_from_starts
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.shooting.measured_spread import cost_of_constants
from cluster_est.shooting.shoot import ShotFit
from cluster_est.uncertainty import intervals
from cluster_est.uncertainty.spaces import with_start

WORTH_TRYING = 0.5
"""Cost of whole records, over that of constants, below which a search on them is begun."""
AS_GOOD = 1e-3
"""Part by which the cost of whole records may be above that of the segments."""
PROMISED = 0.3
"""Ratio of a standard error from whole records to that from segments, below which it is not
believed: states that may differ between segments by what is no difference would undo it."""
EXACT = 1e-9
"""The same over the cost of constants, where nothing is left of the residuals."""


@dataclass(frozen=True)
class WholeFit:
    """What is known after both.

    Attributes
    ----------
    found
        Of the search that counts.
    summary
        For the result; it says which one does.
    """

    found: MultistartResult
    summary: ShootingSummary


def fit_whole_records(
    runner: Runner, train: SearchSpace, method: Method, shot: ShotFit, seed: int
) -> WholeFit:
    """Finish a fit on whole records, if those follow the data from where the segments ended.

    Else the solution on segments stands. It also stands where the derivatives of whole records
    promise much more than those of the segments: of a chaotic model the cost of one trajectory has
    very many minima, all about as good and each far narrower than the distance to the next (L. M.
    Berliner, Stat. Sci. 7 (1992) 69-122, doi:10.1214/ss/1177011444). Where segments led nowhere,
    it is an ordinary fit.
    """
    summary = shot.summary
    if shot.solution is None:
        return WholeFit(search_from_starts(runner, train, method, Multistart(), seed), summary)
    x = shot.solution.x
    runner.display.phase = "whole records"
    (at,) = runner.run([SearchRequest("whole records", GivenPoints(x[None, :], "whole"), train)])
    cost = at.evaluations[0].cost if at.evaluations else np.nan
    summary = replace(summary, whole_cost=float(cost))
    constants = cost_of_constants(train.problem)
    if runner.interrupted or cost < WORTH_TRYING * constants:
        begun = with_start(train, x)
        found = search_from_starts(runner, begun, method, Multistart(), seed)
        least = max(constants, float(len(train.outputs)))
        enough = shot.solution.cost * (1.0 + AS_GOOD) + EXACT * least
        summary = replace(summary, promised=_promised(train, found.best, shot.solution))
        follows = found.best.cost <= enough and summary.promised > PROMISED
        if runner.interrupted or follows:
            return WholeFit(found, replace(summary, joined=True))
    kept = MultistartResult(train.start[None, :], (shot.solution,), (0,), (0,))
    return WholeFit(kept, summary)


def _promised(train: SearchSpace, whole: Solution, segments: Solution) -> float:
    """The least ratio of a standard error from whole records to that from segments."""
    known = [
        np.array([interval.std_error for interval in intervals(train, solution)])
        for solution in (whole, segments)
    ]
    there = (known[0] > 0.0) & (known[1] > 0.0)
    return float(np.min(known[0][there] / known[1][there], initial=1.0))
