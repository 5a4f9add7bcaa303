"""Acceptance of a structure: its predictions, bounded outputs, and credible functions of time.

A structure must predict data to which it was not fitted, and its outputs must stay bounded when the
inputs are enlarged.

Functions of time alone, waves and drifts, must pass more tests than a mechanism, because they
describe a disturbance and hold only for these records. So such a function is accepted only if all
experiments agree on it. In addition, a wave must not be a resonance of the model and must have
enough periods, and a mechanism that explains nearly as much is preferred.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, final

import numpy as np
from typing_extensions import override

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import ENLARGED, FittedModel, Fitter
from cluster_est.closed_loop.selection.linear_model import longest_step
from cluster_est.closed_loop.selection.refits import RefittedCandidate
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.iteration import (
    DAMPING_RATIO,
    NOTICEABLE,
    SHORTEST_SECANT,
)
from cluster_est.methods.least_squares.linear_map import StepSolver
from cluster_est.methods.method import Ending, Evaluation, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.initial_errors import is_start_value
from workers.messages import FloatArray, IntArray, Output
from workers.messages.types import by_content


@dataclass(frozen=True)
class AcceptanceThresholds:
    """Thresholds of the leave-one-out prediction and of the check for stability.

    Attributes
    ----------
    largest_step
        Largest step of a parameter: in logarithms, or as a share of its value. Benchmark.
    unpredicted
        Factor on the squares of a part if no prediction can be simulated. Benchmark.
    reach
        Largest distance of an output with enlarged inputs from its mean, as a multiple of its
        measured half range. Benchmark.
    """

    largest_step: float = 0.5
    unpredicted: float = 4.0
    reach: float = 6.0


ACCEPTANCE = AcceptanceThresholds()

FEW_EXPERIMENTS = 2
"""With at most this number of experiments, parts of records are left out instead of experiments,
because too few experiments would remain."""
QUARTERS = 4
"""Number of parts of a record, if parts are left out."""
TINY = float(np.finfo(float).tiny)
STEPS_WITHOUT_PART = 6
"""Largest number of steps of a refit without a part, which starts close to its solution."""
FIRST_DAMPING = 1e-5
"""Damping of the first step, over the squares of the derivatives. With it, unknowns that the other
parts do not determine keep their values."""

ALONE = 0.01
"""Share of the squared derivatives of a curve's value below which the other parts do not determine
it. By definition: its standard error without the left-out part is ten times as large."""

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

BETTER_PARTS = 2.0 / 3.0
"""Smallest share of the left-out parts that a structure must predict better. Parts without a
difference do not count. By definition: most of them."""
TOLD_APART = 0.01
"""Smallest difference of a part's squares that counts, relative to the mean over all parts of the
earlier prediction. By definition: an effect that acts in few parts leaves the others unchanged."""


@dataclass(frozen=True)
class LeaveOneOutPrediction:
    """The sum of squared errors of each part that was left out.

    `quarters` says that the parts are quarters of records. A quarter that is extrapolated, such as
    the first one, may have nearly all of the squares. So all quarters have the same weight.
    """

    squares: FloatArray
    quarters: bool = False

    @property
    def total(self) -> float:
        return float(self.squares.sum())

    def closes(self, other: LeaveOneOutPrediction, floor: float = 0.0, least: float = 0.0) -> float:
        """Return the closed share of the gap between another prediction's squares and the noise.

        Parameters
        ----------
        floor
            Sum of squares that the noise alone would leave.
        least
            Least size of the gap, as a share of `floor`.
        """
        if not self.quarters:
            return (other.total - self.total) / max(other.total - floor, least * floor, TINY)
        own = floor / len(self.squares)
        gaps = np.maximum(other.squares - own, max(least * own, TINY))
        return float(np.mean(np.clip((other.squares - self.squares) / gaps, -1.0, 1.0)))

    def is_better_than(self, other: LeaveOneOutPrediction) -> bool:
        """Return whether the parts are predicted better: in total, and most of them."""
        if self.closes(other) <= 0.0:
            return False
        change = self.squares - other.squares
        told = np.abs(change) > TOLD_APART * other.total / len(change)
        return bool(np.mean(change[told] < 0.0) >= BETTER_PARTS) if told.any() else False


def predict(fitter: Fitter, fitted: FittedModel) -> LeaveOneOutPrediction:
    """Predict each training experiment from a fit to the others.

    Unknowns that act only on the left-out part, such as its initial state, are estimated with the
    linear model. With one or two experiments, quarters of their records are left out instead. The
    initial states then keep their values, because only the first quarter of a record determines
    them.
    """
    parts = _parts(fitter)
    whole = len(parts) == len(fitter.train)
    held = np.zeros(fitted.space.size, bool)
    if not whole:
        unknowns = fitted.space.unknowns
        held[:] = [is_start_value(u.parameter, fitter.description) for u in unknowns]
    curves = tuple(f"{c.effect.name}." for c in fitted.added if c.form.free)
    local = np.array([u.label.startswith(curves) for u in fitted.space.unknowns], bool)
    refits = [
        RefitWithoutPart(fitted.residuals, fitted.jacobian, part, held, local) for part in parts
    ]
    space = fitted.space.starting_at(fitted.x)
    stage = LoopStage.LEAVE_ONE_OUT
    found = fitter.runner.run([fitter.request(stage, refit, space) for refit in refits])
    return LeaveOneOutPrediction(np.array([end.cost for end in found]), quarters=not whole)


@final
@by_content
@dataclass(frozen=True)
class RefitWithoutPart(Method):
    """Refit a model without a part of the residuals; the cost is the sum of squares of that part.

    The refit starts from the fit to all residuals and their derivatives, with Levenberg-Marquardt
    steps. After each step, Broyden's update corrects the derivatives, so an iteration needs only
    one simulation. The update keeps zeros, because an experiment does not depend on the initial
    states of others (L. K. Schubert, Math. Comp. 24 (1970) 27-30,
    doi:10.1090/S0025-5718-1970-0258276-9). Then the unknowns that act only on the part are fitted
    to it.

    Attributes
    ----------
    fitted, jacobian : (N,), (N, unknowns)
        Residuals of the fit to all residuals, and their derivatives.
    part
        Rows of the part that is left out.
    held : (unknowns,)
        Mask of the unknowns that keep their values.
    local : (unknowns,)
        Mask of the values of free curves. If the part alone determines one, because no other
        part reaches there, it is fitted to the part: a curve is not extrapolated.
    """

    name: ClassVar[str] = "refit without a part"
    needs_residuals: ClassVar[bool] = True

    fitted: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    part: IntArray = field(repr=False)
    held: BoolArray
    local: BoolArray

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        del generator  # the method uses no random numbers
        others = np.ones(len(self.fitted), bool)
        others[self.part] = False
        squares, of_others = (
            np.add.reduce(self.jacobian[rows] ** 2, axis=0) for rows in (slice(None), others)
        )
        shared = (of_others > np.where(self.local, ALONE, 0.0) * squares) & ~self.held
        own = (squares > 0.0) & ~shared & ~self.held
        x, residuals, failed = yield from self._refit(
            space, space.start, self.fitted, others, shared
        )
        if own.any():
            x, residuals, _ = yield from self._refit(space, x, residuals, ~others, own)
        left = float(np.sum(residuals[self.part] ** 2))
        return Solution(x, ACCEPTANCE.unpredicted * left if failed else left, Ending.CONVERGED)

    def _refit(
        self,
        space: SearchSpace,
        x: FloatArray,
        residuals: FloatArray,
        rows: BoolArray,
        unknowns: BoolArray,
    ) -> Generator[Points, list[Evaluation], tuple[FloatArray, FloatArray, bool]]:
        """Refit some unknowns to some of the residuals, and return all residuals at the result.

        Returns the unknowns, all residuals, and whether no step could be simulated.
        """
        matrix, step = self.jacobian[np.ix_(rows, unknowns)], np.zeros(len(x))
        depends, sizes = matrix != 0.0, np.linalg.norm(matrix, axis=0)
        squares = float(np.sum(residuals[rows] ** 2))
        most = longest_step(space, x, ACCEPTANCE.largest_step)
        damping, tried, simulated = FIRST_DAMPING, False, False
        for _ in range(STEPS_WITHOUT_PART if unknowns.any() else 0):
            lower = np.maximum(space.lower - x, -most)[unknowns]
            upper = np.minimum(space.upper - x, most)[unknowns]
            scale = np.linalg.norm(matrix, axis=0)
            solver = StepSolver(matrix, residuals[rows], scale, lower, upper)
            moved = solver.step(damping)
            promised = solver.predicted_cost(np.zeros(len(moved))) - solver.predicted_cost(moved)
            if not moved.any() or (tried and promised <= NOTICEABLE * squares / rows.sum()):
                break
            step[unknowns], tried = moved, True
            (at,) = yield Points((x + step)[None, :], "left out")
            if not at.ok:
                damping = max(damping, FIRST_DAMPING) * DAMPING_RATIO**2
                continue
            simulated, left = True, float(np.sum(at.residuals[rows] ** 2))
            missed = (at.residuals - residuals)[rows] - matrix @ moved
            lengths = depends @ (sizes * moved) ** 2
            seen = lengths > SHORTEST_SECANT * float(np.add.reduce((sizes * moved) ** 2))
            missed = np.divide(missed, lengths, out=np.zeros_like(missed), where=seen)
            matrix = matrix + missed[:, None] * np.where(depends, sizes**2 * moved, 0.0)
            if left < squares:
                x, residuals, squares = x + step, at.residuals, left
                damping /= DAMPING_RATIO
            else:
                damping = max(damping, FIRST_DAMPING) * DAMPING_RATIO**2
        return x, residuals, tried and not simulated


def _parts(fitter: Fitter) -> list[IntArray]:
    """Row indices of the residuals that are left out together."""
    records = fitter.records
    count = len(fitter.train)
    if count > FEW_EXPERIMENTS:
        return [records.of_experiment(e) for e in range(count)]
    parts: list[IntArray] = []
    for e in range(count):
        own = [r for r in records.items if r.experiment == e]
        first = min(float(r.times[0]) for r in own if len(r.times))
        last = max(float(r.times[-1]) for r in own if len(r.times))
        edges = np.linspace(first, last, QUARTERS + 1)[1:-1]
        owner = np.concatenate([np.searchsorted(edges, r.times, side="right") for r in own])
        rows = np.concatenate([np.arange(r.rows.start, r.rows.stop) for r in own])
        parts += [rows[owner == q] for q in range(QUARTERS) if np.any(owner == q)]
    return parts


def is_usable(fitter: Fitter, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Return whether an extended model stays bounded and can be linearised for the next round."""
    return stays_bounded(fitter, fitted, trusted) and can_be_linearised(fitter, fitted)


def stays_bounded(fitter: Fitter, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Return whether no output runs away when the inputs of the training experiments are enlarged.

    An output may reach several times its measured range, or the range that the trusted model gives
    for the same inputs: a loop that starts at rest has a large transient for a displaced reference.
    """
    spaces = [fitter.space(f.start, ENLARGED) for f in (fitted, trusted)]
    (at,), (usual,) = fitter.evaluate(
        LoopStage.ENLARGED_INPUTS, [(s, s.start[None, :]) for s in spaces]
    )
    if not usual.ok:
        return True  # even the trusted model cannot be simulated with such inputs
    if not at.ok:
        return False
    for run, outcome, known in zip(fitter.runs, at.outcomes, usual.outcomes, strict=True):
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
            most = ACCEPTANCE.reach * reach + 1e-9 * abs(mean)
            if _reach(output, outcome.residuals[part], mean) > most:
                return False
    return True


def can_be_linearised(fitter: Fitter, fitted: FittedModel) -> bool:
    """Return whether every training experiment can be linearised along its trajectory.

    An effect may lead the model to the limit of its domain: it can be simulated there, but not at
    a perturbed point, so that nothing can be screened at such a fit.
    """
    try:
        fitter.trajectories(fitted)
    except ProblemError:
        return False
    return True


def _reach(output: Output, residuals: FloatArray, mean: float) -> float:
    """Largest distance of a simulated output from a mean."""
    return float(np.abs(output.values - output.sigmas * residuals - mean).max())


@dataclass(frozen=True)
class WaveThresholds:
    """Additional thresholds that a wave in time must pass.

    Attributes
    ----------
    periods
        Smallest number of periods in the longest record. Signal: with fewer periods, a drift looks
        the same.
    nearly
        Share of the wave's improvement that a mechanism must reach to be preferred. Benchmark.
    apart
        Largest average deviation of the strengths that fit single experiments best, as a share of
        the common strength. Theory: with random phases or signs, the common strength is smaller
        than the single ones.
    """

    periods: float = 3.0
    nearly: float = 0.95
    apart: float = 0.5


TIME_FUNCTIONS = WaveThresholds()

MODES = 5
"""Number of times along a record at which the eigenvalues of the model are computed."""


def admissible(
    fitter: Fitter, current: FittedModel, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Return the contenders whose functions of time are credible, the preferred one first.

    The contenders extend `current`; the best one must come first.
    """
    left = [c for c in contenders if _is_admissible(fitter, current, c.fitted)]
    if not left or not _waves(left[0].fitted, current):
        return left
    gain = current.sse - left[0].fitted.sse
    least = TIME_FUNCTIONS.nearly * gain
    others = [c for c in left if not _waves(c.fitted, current) and not c.candidate.form.free]
    first = [c for c in others if current.sse - c.fitted.sse >= least]
    return [*first, *(c for c in left if c not in first)] if first else left


def period_of(candidate: EffectCandidate, fitted: FittedModel) -> float:
    """Return the period in seconds of a wave in time; NaN for all other effects."""
    frequency = fitted.estimates.get(f"{candidate.effect.name}.f", np.nan)
    wave = candidate.form.of_time_alone and frequency > 0.0
    return 2.0 * np.pi / frequency if wave else np.nan


def residuals_without(fitted: FittedModel, candidate: EffectCandidate) -> FloatArray:
    """Return the residuals without a wave in time, to first order."""
    labels = [u.label for u in fitted.space.unknowns]
    sine_and_cosine = [f"{candidate.effect.name}.{part}" for part in ("a", "b")]
    columns = [labels.index(name) for name in sine_and_cosine if name in labels]
    return fitted.residuals - fitted.jacobian[:, columns] @ fitted.x[columns]


def _waves(fitted: FittedModel, current: FittedModel) -> list[EffectCandidate]:
    """The new effects that are waves in time."""
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    return [c for c in new if np.isfinite(period_of(c, fitted))]


def _is_admissible(fitter: Fitter, current: FittedModel, fitted: FittedModel) -> bool:
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    if not all(_agrees(fitter, fitted, c) for c in new if c.form.of_time_alone):
        return False
    longest = max(float(np.ptp(r.times)) for r in fitter.records.items if len(r.times))
    periods = [period_of(candidate, fitted) for candidate in _waves(fitted, current)]
    return all(
        longest >= TIME_FUNCTIONS.periods * period
        and not _is_resonance(fitter, current, 2.0 * np.pi / period)
        for period in periods
    )


def _is_resonance(fitter: Fitter, current: FittedModel, frequency: float) -> bool:
    """Return whether a frequency lies within the width of a resonance of the model.

    A disturbance of a lightly damped model leaves a residual at its resonance. An eigenvalue s is
    a resonance if its damping ratio -Re(s) / |s| is below 1/2. Its width is |Re(s)|, half of the
    width of its power, but at least a tenth of its frequency. The eigenvalues of a nonlinear model
    change along a record. A resonance counts only if it exists in at least half of the record.
    """
    for trajectory in fitter.trajectories(current):
        if trajectory.linear is None:
            return False
        steps = np.linspace(0, len(trajectory.linear.times) - 1, MODES).astype(int)
        places = np.unique(steps).tolist()
        near = [_rings_at(trajectory.linear.A.at(step), frequency) for step in places]
        if 2 * sum(near) >= len(places):
            return True
    return False


def _rings_at(matrix: FloatArray, frequency: float) -> bool:
    """Return whether a linear system has a resonance whose width contains this frequency."""
    modes = np.linalg.eigvals(matrix)
    size = np.abs(modes)
    rings = (modes.imag > 0.0) & (-modes.real < 0.5 * size)
    width = np.maximum(np.abs(modes.real), 0.1 * size)
    return bool(np.any(rings & (np.abs(modes.imag - frequency) <= width)))


def _agrees(fitter: Fitter, fitted: FittedModel, candidate: EffectCandidate) -> bool:
    """Return whether each experiment alone would choose nearly the common function of time.

    To first order, the strengths for one experiment are the common ones plus a least-squares step
    on its own residual. The step that white noise alone would cause is subtracted. With only one
    experiment, there is nothing to compare.
    """
    labels = [u.label for u in fitted.space.unknowns]
    names = [f"{candidate.effect.name}.{strength}" for strength in candidate.strengths]
    if len(fitter.train) < 2 or not names or not all(name in labels for name in names):
        return True
    columns = [labels.index(name) for name in names]
    shared = np.array([fitted.x[column] for column in columns])
    squares, weights = [], []
    for rows in fitted.space.rows:
        own: FloatArray = fitted.jacobian[rows][:, columns]
        size = float(np.linalg.norm(own))
        if size > 0.0:
            inverse = np.linalg.pinv(own, rcond=1e-6)
            step = -inverse @ fitted.residuals[rows]
            left = fitted.residuals[rows] + own @ step
            noise = float(np.mean(left**2)) * float(np.add.reduce(inverse**2, axis=None))
            squares.append(float(step @ step) - noise)
            weights.append(size)
    if not squares:
        return True
    apart = float(np.sqrt(max(np.average(squares, weights=weights), 0.0)))
    return apart <= TIME_FUNCTIONS.apart * float(np.linalg.norm(shared))
