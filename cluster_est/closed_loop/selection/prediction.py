"""Acceptance of an effect: prediction of what it was not fitted to, and bounded outputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, final

import numpy as np
from typing_extensions import override

from cluster_est.closed_loop.fitter import ENLARGED, FittedModel, Fitter
from cluster_est.closed_loop.selection.linear_model import longest_step
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.iteration import DAMPING_RATIO, NOTICEABLE
from cluster_est.methods.least_squares.linear_map import StepSolver
from cluster_est.methods.method import Ending, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.initial_errors import is_start_value
from cluster_est.running.search_state import SearchRequest
from workers.messages import FloatArray, IntArray, Output
from workers.messages.types import by_content


@dataclass(frozen=True)
class AcceptanceThresholds:
    """Thresholds of the leave-one-out prediction and of the check for stability.

    Attributes
    ----------
    steps
        Of a refit without a part, which starts close to its end. Benchmark.
    damping
        Of its first one: what the other parts do not determine stays. Theory: a hundredth of a
        thousandth of the squares of the derivatives.
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

    steps: int = 6
    damping: float = 1e-5
    largest_step: float = 0.5
    few: int = 2
    parts: int = 4
    unpredicted: float = 4.0
    reach: float = 6.0


ACCEPTANCE = AcceptanceThresholds()


@dataclass(frozen=True)
class LeaveOneOutPrediction:
    """Leave-one-out prediction: a sum of squares for each part that was left out."""

    squares: FloatArray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def predict(fitter: Fitter, fitted: FittedModel) -> LeaveOneOutPrediction:
    """Predict each training experiment from a fit to the others.

    What acts on the left-out part alone, as its initial state, follows by the linear model. With
    one or two experiments, quarters of their records take the experiments' place; there initial
    states keep their values, as a record's first quarter is all that says where it began.
    """
    parts = _parts(fitter)
    whole = len(parts) == len(fitter.train)
    held = np.zeros(fitted.space.size, bool)
    if not whole:
        unknowns = fitted.space.unknowns
        held[:] = [is_start_value(u.parameter, fitter.description) for u in unknowns]
    refits = [RefitWithoutPart(fitted.residuals, fitted.jacobian, part, held) for part in parts]
    space = fitted.space.starting_at(fitted.x)
    stage = LoopStage.LEAVE_ONE_OUT.value
    found = fitter.runner.run([SearchRequest(stage, refit, space, fitter.seed) for refit in refits])
    return LeaveOneOutPrediction(np.array([end.cost for end in found]))


@final
@by_content
@dataclass(frozen=True)
class RefitWithoutPart(Method):
    """Refit a model to all residuals but some, from its fit to all; the cost is that of the part.

    Levenberg-Marquardt steps whose derivatives begin as those of the fit to all, and are corrected
    by what each step has shown (C. G. Broyden, Math. Comp. 19 (1965) 577-593,
    doi:10.1090/S0025-5718-1965-0198670-6), so that an iteration is one simulation.

    Attributes
    ----------
    fitted, jacobian : (N,), (N, unknowns)
        Residuals of the fit to all, and their derivatives.
    part
        Rows of what is left out.
    held : (unknowns,)
        Unknowns that keep their values.
    """

    name: ClassVar[str] = "refit without a part"
    needs_residuals: ClassVar[bool] = True

    fitted: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    part: IntArray = field(repr=False)
    held: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        del generator  # nothing is drawn
        others = np.ones(len(self.fitted), bool)
        others[self.part] = False
        x, residuals, matrix = space.start, self.fitted, self.jacobian
        squares = float(np.sum(residuals[others] ** 2))
        own = float(np.sum(residuals[self.part] ** 2))
        damping, simulated, sizes = ACCEPTANCE.damping, False, np.linalg.norm(matrix, axis=0)
        for number in range(ACCEPTANCE.steps):
            step, promised = self._step(space, x, residuals, matrix, others, damping)
            if not step.any() or (number and promised <= NOTICEABLE * squares / others.sum()):
                break
            (at,) = yield Points((x + step)[None, :], "left out")
            simulated |= at.ok
            left = float(np.sum(at.residuals[others] ** 2)) if at.ok else np.inf
            if not left < squares:
                damping = max(damping, ACCEPTANCE.damping) * DAMPING_RATIO**2
                continue
            missed, direction = at.residuals - residuals - matrix @ step, sizes**2 * step
            matrix = matrix + np.outer(missed, direction / float(direction @ step))
            x, residuals, squares, damping = x + step, at.residuals, left, damping / DAMPING_RATIO
            own = float(np.sum(residuals[self.part] ** 2))
        failed = number > 0 and not simulated
        return Solution(x, ACCEPTANCE.unpredicted * own if failed else own, Ending.CONVERGED)

    def _step(
        self,
        space: SearchSpace,
        x: FloatArray,
        residuals: FloatArray,
        matrix: FloatArray,
        others: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
        damping: float,
    ) -> tuple[FloatArray, float]:
        """Return a step, and the fall of the sum of squares that the linear model promises."""
        seen = matrix[others]
        known = (np.linalg.norm(seen, axis=0) > 0.0) & ~self.held
        step = np.zeros(len(x))
        if not known.any():
            return step, 0.0
        most = longest_step(space, x, ACCEPTANCE.largest_step)
        lower, upper = np.maximum(space.lower - x, -most), np.minimum(space.upper - x, most)
        scale = np.linalg.norm(matrix[:, known], axis=0)
        solver = StepSolver(seen[:, known], residuals[others], scale, lower[known], upper[known])
        step[known] = solver.step(damping)
        promised = solver.predicted_cost(np.zeros(known.sum())) - solver.predicted_cost(step[known])
        own = matrix[self.part]
        alone = ~known & ~self.held & (np.linalg.norm(own, axis=0) > 0.0)
        if alone.any():
            wanted = np.linalg.lstsq(own[:, alone], -own @ step, rcond=1e-6)[0]
            step[alone] = np.clip(wanted, lower[alone], upper[alone])
        return step, promised


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
