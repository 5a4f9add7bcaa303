"""What a refit must come down to, to be of any use, and whether the linear model lets it hope.

A refit costs many simulations and what it could reach is known beforehand, roughly: on the
benchmark the fall of the sum of squares is 1.1 times what the linear model promises as a median,
and 2.5 times in one of a hundred cases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.selection.refinement.linear_step import gauss_newton_step
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.records import StackedRecords
from workers.messages import FloatArray


@dataclass(frozen=True)
class UsefulFit:
    """What a refit must come down to.

    Attributes
    ----------
    criterion, sse
        Its criterion and its sum of squares at most.
    """

    criterion: float = np.inf
    sse: float = np.inf


ANY_FIT = UsefulFit()


def promised(workbench: LoopWorkbench, fitted: FittedModel) -> float:
    """Return the criterion that the linear model promises after one more step without bounds."""
    return _ahead(fitted).criterion(workbench.records)


def may_become_useful(workbench: LoopWorkbench, fitted: FittedModel, useful: UsefulFit) -> bool:
    """Return whether more iterations could bring a fit down to what it must reach.

    The linear model says how far one more step would lead, if there were no bounds. After some
    iterations the rest of a fit brings little more than that, so some times as much is allowed.
    """
    times, ahead = workbench.thresholds.refinement.linear_promise, _ahead(fitted)
    criteria = [each.criterion(workbench.records) for each in (fitted, ahead)]
    criterion = criteria[0] - times * (criteria[0] - criteria[1])
    sse = fitted.sse - times * (fitted.sse - ahead.sse)
    return bool(criterion <= useful.criterion and sse <= useful.sse)


def may_start_useful(
    workbench: LoopWorkbench,
    current: FittedModel,
    shares: FloatArray,
    added: int,
    useful: UsefulFit,
) -> bool:
    """Return whether a model with new unknowns could come down to what it must reach.

    Parameters
    ----------
    current
        The model without them.
    shares : (outputs,)
        Of its squares that the linear model leaves after a step of all unknowns.
    added
        Number of new unknowns.
    """
    records, thresholds = workbench.records, workbench.thresholds.refinement
    total, likelihood = 0.0, 0.0
    for output, share in enumerate(shares.tolist()):
        part = current.residuals[records.of_output(output)]
        if len(part):
            squares = float(np.add.reduce(part**2))
            total += squares * max(1.0 - thresholds.claim_promise * (1.0 - share), 0.0)
            rest = squares * max(1.0 - thresholds.rival_promise * (1.0 - share), 0.0)
            likelihood += len(part) * np.log(max(rest / len(part), 1e-300))
    price = (current.space.size + added) * np.log(len(current.residuals))
    return bool(total <= useful.sse and likelihood + price <= useful.criterion)


def shares_left(records: StackedRecords, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the share (outputs,) of each output's squares that is left.

    Parameters
    ----------
    records
        Of the residuals.
    before, after : (N,)
        The residuals, and those of the linear model.
    """
    rows = [records.of_output(output) for output in range(len(records.outputs))]
    squares = [(np.add.reduce(after[r] ** 2), np.add.reduce(before[r] ** 2)) for r in rows]
    return np.array([a / b if b > 0.0 else 1.0 for a, b in squares])


def _ahead(fitted: FittedModel) -> FittedModel:
    step = gauss_newton_step(fitted.jacobian, fitted.residuals)
    return replace(fitted, residuals=fitted.residuals + fitted.jacobian @ step)
