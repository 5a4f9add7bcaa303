"""From the outcomes of a point to its cost and constraints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation, joined_residuals
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray, Outcome


def assemble_evaluation(
    space: SearchSpace, x: FloatArray, outcomes: tuple[Outcome, ...], index: int
) -> Evaluation:
    """Join the outcomes of a point's experiments, which stand in their order.

    Parameters
    ----------
    space, x
        Where the point lies.
    outcomes
        One for each experiment of the space, with its priors.
    index
        The number of the point among all that its search has asked for.
    """
    if not all(outcome.ok for outcome in outcomes):
        return Evaluation(outcomes, np.nan, violation=np.nan, index=index)
    cost = space.problem.cost.value(joined_residuals(outcomes), space.outputs)
    if not space.constraint_names:
        return Evaluation(outcomes, cost, index=index)
    parts = [space.parameter_constraints(x), *(outcome.constraints for outcome in outcomes)]
    constraints = np.concatenate(parts)
    return Evaluation(outcomes, cost, constraints, violation(constraints, space.equality), index)


def with_priors(space: SearchSpace, x: FloatArray, e: int, outcome: Outcome) -> Outcome:
    """Return the outcome of an experiment with the residuals of the priors that count with it.

    They stand in no log and come from no worker: they follow from the point alone.
    """
    if not outcome.ok or not len(space.priors.places[e]):
        return outcome
    known = np.zeros(0) if outcome.residuals is None else outcome.residuals
    return replace(outcome, residuals=np.concatenate([known, space.priors.residuals(e, x)]))


def with_continuity(space: SearchSpace, x: FloatArray, e: int, outcome: Outcome) -> Outcome:
    """Return the outcome of a segment with the differences between its end and the next start."""
    if space.continuity is None or not outcome.ok or outcome.residuals is None:
        return outcome
    return replace(outcome, residuals=space.continuity.applied(e, x, outcome.residuals))


def violation(constraints: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    """The largest violation; 0 where all are satisfied, infinite where one has no value."""
    if np.isnan(constraints).any():
        return np.inf
    sizes = np.where(equality, np.abs(constraints), np.maximum(constraints, 0.0))
    return float(sizes.max(initial=0.0))
