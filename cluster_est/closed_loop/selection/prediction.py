"""Acceptance of an effect: prediction of what it was not fitted to, and bounded outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.fitter import ENLARGED, FittedModel, Fitter
from cluster_est.closed_loop.selection.linear_model import longest_step
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from workers.messages import FloatArray, IntArray, Output


@dataclass(frozen=True)
class AcceptanceThresholds:
    """Thresholds of the leave-one-out prediction and of the check for stability.

    Attributes
    ----------
    step_lengths
        Parts of the Gauss-Newton step to the fit without a part. Benchmark.
    largest_step
        Of a parameter: in logarithms, or as a share of its value. Benchmark.
    few
        Up to so many experiments, parts of their records are left out instead: without one there
        would be one left, or none. By definition.
    parts
        Of a record that is left out in parts. Benchmark.
    unpredicted
        Factor on its own squares where no prediction can be simulated. Benchmark.
    reach
        Times its measured half range that an output may reach with enlarged inputs. Benchmark.
    """

    step_lengths: tuple[float, ...] = (1.0, 0.4)
    largest_step: float = 0.5
    few: int = 2
    parts: int = 4
    unpredicted: float = 4.0
    reach: float = 6.0


ACCEPTANCE = AcceptanceThresholds()


GUARD = 1.0001
"""Of a comparison of sums of squares: above rounding."""


@dataclass(frozen=True)
class LeaveOneOutPrediction:
    """Leave-one-out prediction: a sum of squares for each part that was left out."""

    squares: FloatArray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def predict(fitter: Fitter, fitted: FittedModel) -> LeaveOneOutPrediction:
    """Predict each training experiment from the others.

    The fit to the others is one Gauss-Newton step away, since all but one experiment were in it
    already; its length is chosen so that the others do not get worse, and the prediction is a real
    simulation. What acts on the left-out part alone, as its initial state, follows by the linear
    model. With one or two experiments, quarters of their records take the experiments' place.
    """
    parts = _parts(fitter)
    lengths = len(ACCEPTANCE.step_lengths)
    points = [_left_out(fitted, part) for part in parts]
    (seen,) = fitter.evaluate(LoopStage.LEAVE_ONE_OUT, [(fitted.space, np.vstack(points))])
    squares = np.empty(len(parts))
    for number, part in enumerate(parts):
        own = float(np.sum(fitted.residuals[part] ** 2))
        squares[number] = ACCEPTANCE.unpredicted * own
        for at in seen[lengths * number : lengths * (number + 1)]:
            if not at.ok:
                continue
            squares[number] = min(squares[number], own)
            here = float(np.sum(at.residuals[part] ** 2))
            if float(np.sum(at.residuals**2)) - here <= GUARD * (fitted.sse - own):
                squares[number] = here
                break
    return LeaveOneOutPrediction(squares)


def _parts(fitter: Fitter) -> list[IntArray]:
    """The residuals that are left out together."""
    records = fitter.records
    count = len(fitter.train)
    if count > ACCEPTANCE.few:
        return [records.of_experiment(e) for e in range(count)]
    parts: list[IntArray] = []
    for e in range(count):
        own = [r for r in records.items if r.experiment == e]
        first = min(float(r.times[0]) for r in own if len(r.times))
        last = max(float(r.times[-1]) for r in own if len(r.times))
        edges = np.linspace(first, last, ACCEPTANCE.parts + 1)[1:-1]
        owner = np.concatenate([np.searchsorted(edges, r.times, side="right") for r in own])
        rows = np.concatenate([np.arange(r.rows.start, r.rows.stop) for r in own])
        parts += [rows[owner == q] for q in range(ACCEPTANCE.parts) if np.any(owner == q)]
    return parts


def is_usable(fitter: Fitter, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Return whether a grown model stays bounded, and can be linearised to go on from."""
    return stays_bounded(fitter, fitted, trusted) and can_be_linearised(fitter, fitted)


def stays_bounded(fitter: Fitter, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Return whether no output runs away when the training inputs swing further.

    It may go as far as several times what was measured, or what the trusted model makes of the
    same inputs: a loop that starts at rest answers a displaced reference with a large transient.
    """
    spaces = [fitter.space(f.start, ENLARGED) for f in (fitted, trusted)]
    (at,), (usual,) = fitter.evaluate(
        LoopStage.ENLARGED_INPUTS, [(s, s.start[None, :]) for s in spaces]
    )
    if not usual.ok:
        return True  # such inputs are beyond the model itself
    if not at.ok:
        return False
    most = ACCEPTANCE.reach
    for experiment, outcome, known in zip(fitter.train, at.outcomes, usual.outcomes, strict=True):
        run = fitter.problem.experiments[experiment]
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
            if _reach(output, outcome.residuals[part], mean) > most * reach + 1e-9 * abs(mean):
                return False
    return True


def can_be_linearised(fitter: Fitter, fitted: FittedModel) -> bool:
    """Return whether every training experiment has a linear model along its trajectory.

    An effect may lead the model to the edge of where it has an answer: it can be simulated there,
    and a step to the side cannot. Nothing can be screened at such a fit.
    """
    try:
        fitter.trajectories(fitted)
    except ProblemError:
        return False
    return True


def _reach(output: Output, residuals: FloatArray, mean: float) -> float:
    """Largest distance of a simulated output from a mean."""
    return float(np.abs(output.values - output.sigmas * residuals - mean).max())


def _left_out(fitted: FittedModel, part: IntArray) -> FloatArray:
    """Points towards the fit without some residuals, longest step first."""
    others = np.ones(len(fitted.residuals), bool)
    others[part] = False
    matrix, residuals = fitted.jacobian[others], fitted.residuals[others]
    sizes = np.linalg.norm(matrix, axis=0)
    usable = sizes > 0.0
    step = np.zeros(len(fitted.x))
    if usable.any():
        scaled = matrix[:, usable] / sizes[usable]
        step[usable] = np.linalg.lstsq(scaled, -residuals, rcond=1e-6)[0] / sizes[usable]
    own = fitted.jacobian[part]
    alone = ~usable & (np.linalg.norm(own, axis=0) > 0.0)
    if alone.any():
        step[alone] = np.linalg.lstsq(own[:, alone], -own @ step, rcond=1e-6)[0]
    most = longest_step(fitted.space, fitted.x, ACCEPTANCE.largest_step)
    step = np.clip(step, -most, most)
    points = [fitted.x + length * step for length in ACCEPTANCE.step_lengths]
    return np.clip(np.array(points), fitted.space.lower, fitted.space.upper)
