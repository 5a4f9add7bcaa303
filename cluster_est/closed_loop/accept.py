"""Whether an effect may be added: does it predict what it was not fitted to, and stay bounded?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.workbench import Fitted, Workbench
from workers.messages import FloatArray

CV_STEPS = (1.0, 0.4)
CV_LARGEST = 0.5
BOUND = 6.0
"""Times its measured half range that an output may reach when the inputs are enlarged."""
GUARD = 1.0001


@dataclass(frozen=True)
class Prediction:
    """Leave-one-experiment-out prediction: a sum of squares for each training experiment."""

    squares: FloatArray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def predict(bench: Workbench, fitted: Fitted) -> Prediction:
    """Predict each training experiment from the others.

    The fit to the others is one Gauss-Newton step away, since all but one experiment were in it
    already; its length is chosen so that the others do not get worse, and the prediction is a real
    simulation. With a single experiment there is nothing to predict it from: its own fit counts.
    """
    count = len(bench.train)
    if count == 1:
        return Prediction(np.array([fitted.sse]))
    points = [_left_out(fitted, e) for e in range(count)]
    (seen,) = bench.look("leave one out", [(fitted.space, np.vstack(points))])
    squares = np.empty(count)
    rows = fitted.space.rows
    for e in range(count):
        own = float(np.sum(fitted.residuals[rows[e]] ** 2))
        squares[e] = np.nan
        for at in seen[len(CV_STEPS) * e : len(CV_STEPS) * (e + 1)]:
            if not at.ok:
                continue
            residuals = at.residuals
            here = float(np.sum(residuals[rows[e]] ** 2))
            if float(np.sum(residuals**2)) - here <= GUARD * (fitted.sse - own):
                squares[e] = here
                break
        if np.isnan(squares[e]):
            squares[e] = own
    return Prediction(squares)


def stays_bounded(bench: Workbench, fitted: Fitted) -> bool:
    """Whether no output runs away when the training inputs swing a quarter further."""
    space = bench.space(fitted.start, "enlarged")
    ((at,),) = bench.look("enlarged", [(space, space.start[None, :])])
    if not at.ok:
        return False
    for experiment, outcome in zip(bench.train, at.outcomes, strict=True):
        run = bench.problem.experiments[experiment]
        first = 0
        for output in run.outputs:
            part = slice(first, first + len(output.times))
            first = part.stop
            if outcome.residuals is None or not len(output.times):
                continue
            simulated = output.values - output.sigma * outcome.residuals[part]
            mean = output.values.mean()
            reach = np.abs(output.values - mean).max()
            if np.abs(simulated - mean).max() > BOUND * reach + 1e-9 * abs(mean):
                return False
    return True


def _left_out(fitted: Fitted, e: int) -> FloatArray:
    """Points towards the fit without experiment e, longest step first."""
    rows = fitted.space.rows[e]
    others = np.ones(len(fitted.residuals), bool)
    others[rows] = False
    matrix, residuals = fitted.jacobian[others], fitted.residuals[others]
    acting = np.array([set(u.experiments) != {e} for u in fitted.space.unknowns], bool)
    sizes = np.linalg.norm(matrix, axis=0)
    usable = acting & (sizes > 0.0)
    step = np.zeros(len(fitted.x))
    if usable.any():
        scaled = matrix[:, usable] / sizes[usable]
        step[usable] = np.linalg.lstsq(scaled, -residuals, rcond=1e-6)[0] / sizes[usable]
    size = np.maximum(np.abs(fitted.x), fitted.space.typical)
    step = np.clip(step, -CV_LARGEST * size, CV_LARGEST * size)
    points = [fitted.x + part * step for part in CV_STEPS]
    return np.clip(np.array(points), fitted.space.lower, fitted.space.upper)
