"""The last steps of a least-squares search, where changes of the cost are rounding errors.

A minimum is flat: at half of a double's digits in the unknowns all digits of the cost are used up.
The gradient has more of them. So near the end the full step is taken, one point at a time, as long
as it does not raise the cost by more than counts as no change. Gauss-Newton steps approach a
minimum with large residuals only linearly; two of them in a row are extrapolated by Anderson's
formula of depth one (H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011) 1715-1735,
doi:10.1137/10078356X).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Points
from cluster_est.methods.least_squares.iteration import (
    CLOSE,
    LEAST_DAMPING,
    IterationState,
    Result,
)
from cluster_est.methods.least_squares.local_model import LocalModel
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray

FINAL_PART = 1e-6
"""Part of `ftol` below which the relative reduction ends the search."""
LARGEST_FACTOR = 10.0
"""Most by which the extrapolation may lengthen a step."""


def final_step(
    space: SearchSpace, state: IterationState, model: LocalModel, ftol: float
) -> Generator[Points, list[Evaluation], Result | None]:
    """Take the full step. Return None if the point is not close, or the step raises the cost."""
    step = model.step(LEAST_DAMPING)
    reduction = model.predicted_reduction(step) / model.squares if model.squares > 0.0 else np.inf
    if reduction > CLOSE:
        return None
    if reduction <= FINAL_PART * ftol:
        return state, Ending.CONVERGED
    x = np.clip(state.x + _extrapolated(state, step, model), space.lower, space.upper)
    (at,) = yield Points(x[None, :], "polish", state.progress)
    if not at.ok or not at.cost <= state.at.cost + ftol * model.squares:
        return None if reduction > ftol else (state, Ending.CONVERGED)
    rate = reduction / state.relative_reduction if state.relative_reduction > 0.0 else 1.0
    again = state.full_step is not None
    new = state.moved(space, x, at, state.damping)
    new = replace(new, relative_reduction=reduction, full_step=(state.x, step))
    ended = reduction * rate <= FINAL_PART * ftol or (again and rate > 0.5)
    return new, Ending.CONVERGED if ended else None


def _extrapolated(state: IterationState, step: FloatArray, model: LocalModel) -> FloatArray:
    """Return the step after Anderson's extrapolation with the full step before."""
    if state.full_step is None:
        return step
    x, before = state.full_step
    change = step - before
    square = model.norm(change) ** 2
    if square == 0.0:
        return step
    gamma = model.inner_product(change, step) / square
    longer = step - gamma * (state.x + step - x - before)
    return longer if model.norm(longer) <= LARGEST_FACTOR * model.norm(step) else step
