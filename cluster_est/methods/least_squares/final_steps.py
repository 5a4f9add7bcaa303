"""The last steps of a least-squares search, where the cost can no longer tell better from worse.

A minimum is flat: at half of a double's digits in the unknowns all digits of the cost are used up.
The derivatives know more. So near the end the full step is taken, one point at a time, as long as
it does not raise the cost by more than what counts as no change. Gauss-Newton steps approach a
minimum with large residuals only linearly; two of them in a row are extrapolated by Anderson's
formula of depth one (H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011) 1715-1735,
doi:10.1137/10078356X).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Points
from cluster_est.methods.least_squares.iteration import LEAST_DAMPING, IterationState, Result
from cluster_est.methods.least_squares.local_model import LocalModel
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

CLOSE = 1e-6
"""What a full step may promise, over the sum of squares, for the point to be close to the end."""
EXACT = 1e-6
"""Part of `ftol` that is left to gain where the search has ended."""
LARGEST_FACTOR = 10.0
"""Most by which the extrapolation may lengthen a step."""


def polish(
    space: SearchSpace, state: IterationState, model: LocalModel, ftol: float
) -> Generator[Points, list[Evaluation], Result | None]:
    """Take the full step. None where the point is not close, or the step is not to be trusted."""
    step = model.step(LEAST_DAMPING)
    offset = model.gain(step) / model.squares if model.squares > 0.0 else np.inf
    if offset > CLOSE:
        return None
    if offset <= EXACT * ftol:
        return state, Ending.CONVERGED
    x = np.clip(state.x + _extrapolated(state, step, model), space.lower, space.upper)
    (at,) = yield Points(x[None, :], "polish", state.progress)
    if not at.ok or not at.cost <= state.at.cost + ftol * model.squares:
        return None if offset > ftol else (state, Ending.CONVERGED)
    rate = offset / state.offset if state.offset > 0.0 else 1.0
    again = state.full_step is not None
    new = state.moved(space, x, at, state.damping)
    new = replace(new, offset=offset, full_step=(state.x, step))
    ended = offset * rate <= EXACT * ftol or (again and rate > 0.5)
    return new, Ending.CONVERGED if ended else None


def _extrapolated(state: IterationState, step: FloatArray, model: LocalModel) -> FloatArray:
    """The step, lengthened by what it and the one before tell of how they shrink."""
    if state.full_step is None:
        return step
    x, before = state.full_step
    change = step - before
    square = model.length(change) ** 2
    if square == 0.0:
        return step
    part = model.product(change, step) / square
    longer = step - part * (state.x + step - x - before)
    return longer if model.length(longer) <= LARGEST_FACTOR * model.length(step) else step
