"""Whether an effect may be added: does it predict what it was not fitted to, and stay bounded?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from workers.messages import FloatArray, IntArray, Output

CV_STEPS = (1.0, 0.4)
CV_LARGEST = 0.5
"""Largest step of a parameter: in logarithms, or as a share of its value."""
BOUND = 6.0
"""Times its measured half range that an output may reach when the inputs are enlarged."""
GUARD = 1.0001
FEW = 2
"""Up to so many experiments, parts of their records are left out instead."""
QUARTERS = 4
UNPREDICTED = 4.0
"""What its own squares count where no prediction can be simulated."""


@dataclass(frozen=True)
class LeaveOneOutPrediction:
    """Leave-one-out prediction: a sum of squares for each part that was left out."""

    squares: FloatArray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def predict(bench: LoopWorkbench, fitted: FittedModel) -> LeaveOneOutPrediction:
    """Predict each training experiment from the others.

    The fit to the others is one Gauss-Newton step away, since all but one experiment were in it
    already; its length is chosen so that the others do not get worse, and the prediction is a real
    simulation. With one or two experiments, quarters of their records take the experiments' place.
    """
    parts = _parts(bench)
    points = [_left_out(fitted, part) for part in parts]
    (seen,) = bench.look("leave one out", [(fitted.space, np.vstack(points))])
    squares = np.empty(len(parts))
    for number, part in enumerate(parts):
        own = float(np.sum(fitted.residuals[part] ** 2))
        squares[number] = UNPREDICTED * own
        for at in seen[len(CV_STEPS) * number : len(CV_STEPS) * (number + 1)]:
            if not at.ok:
                continue
            squares[number] = min(squares[number], own)
            here = float(np.sum(at.residuals[part] ** 2))
            if float(np.sum(at.residuals**2)) - here <= GUARD * (fitted.sse - own):
                squares[number] = here
                break
    return LeaveOneOutPrediction(squares)


def _parts(bench: LoopWorkbench) -> list[IntArray]:
    """The residuals that are left out together."""
    records = bench.records
    count = len(bench.train)
    if count > FEW:
        return [records.of_experiment(e) for e in range(count)]
    parts: list[IntArray] = []
    for e in range(count):
        own = [r for r in records.items if r.experiment == e]
        first = min(float(r.times[0]) for r in own if len(r.times))
        last = max(float(r.times[-1]) for r in own if len(r.times))
        edges = np.linspace(first, last, QUARTERS + 1)[1:-1]
        quarter = np.concatenate([np.searchsorted(edges, r.times, side="right") for r in own])
        rows = np.concatenate([np.arange(r.rows.start, r.rows.stop) for r in own])
        parts += [rows[quarter == q] for q in range(QUARTERS) if np.any(quarter == q)]
    return parts


def stays_bounded(bench: LoopWorkbench, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Whether no output runs away when the training inputs swing a quarter further.

    It may go as far as several times what was measured, or what the trusted model makes of the
    same inputs: a loop that starts at rest answers a displaced reference with a large transient.
    """
    spaces = [bench.space(f.start, "enlarged") for f in (fitted, trusted)]
    (at,), (usual,) = bench.look("enlarged", [(s, s.start[None, :]) for s in spaces])
    if not usual.ok:
        return True  # such inputs are beyond the model itself
    if not at.ok:
        return False
    for experiment, outcome, known in zip(bench.train, at.outcomes, usual.outcomes, strict=True):
        run = bench.problem.experiments[experiment]
        first = 0
        for output in run.outputs:
            part = slice(first, first + len(output.times))
            first = part.stop
            if outcome.residuals is None or not len(output.times):
                continue
            mean = output.values.mean()
            reach = np.abs(output.values - mean).max()
            if known.residuals is not None:
                reach = max(reach, _reach(output, known.residuals[part], mean))
            if _reach(output, outcome.residuals[part], mean) > BOUND * reach + 1e-9 * abs(mean):
                return False
    return True


def _reach(output: Output, residuals: FloatArray, mean: float) -> float:
    """How far from a mean a simulated output goes."""
    return float(np.abs(output.values - output.sigma * residuals - mean).max())


def _left_out(fitted: FittedModel, part: IntArray) -> FloatArray:
    """Points towards the fit without some residuals, longest step first."""
    others = np.ones(len(fitted.residuals), bool)
    others[part] = False
    matrix, residuals = fitted.jacobian[others], fitted.residuals[others]
    sizes = np.linalg.norm(matrix, axis=0)
    usable = sizes > 0.0  # what acts on the left-out part alone stays as it is
    step = np.zeros(len(fitted.x))
    if usable.any():
        scaled = matrix[:, usable] / sizes[usable]
        step[usable] = np.linalg.lstsq(scaled, -residuals, rcond=1e-6)[0] / sizes[usable]
    log = np.array([u.log for u in fitted.space.unknowns], bool)
    size = np.where(log, 1.0, np.maximum(np.abs(fitted.x), fitted.space.typical))
    step = np.clip(step, -CV_LARGEST * size, CV_LARGEST * size)
    points = [fitted.x + length * step for length in CV_STEPS]
    return np.clip(np.array(points), fitted.space.lower, fitted.space.upper)
