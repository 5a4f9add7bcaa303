"""Sequential quadratic programming with a trust region, made for few and costly simulations.

An iteration is two requests: the points of the derivatives, then one trial step. The step minimises
a quadratic model of the cost plus a penalty on the violation of the linearised constraints, within
the bounds and a trust region (R. Fletcher, Practical Methods of Optimization, 2nd ed. (1987),
section 14.4). A rejected step costs one point, not new derivatives.

- The curvature of a sum of squares comes with its Jacobian (curvature.py).
- The penalty starts low and grows only where it must (penalty.py).
- A step that bent constraints spoil is corrected with their values at the trial point.
- At a kink of a constraint the derivatives at the rejected point are asked for, and both faces
  count from then on (linear_pieces.py).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Points, Progress, Search, Solution
from cluster_est.methods.curvature import Curvature, Hessian
from cluster_est.methods.differences import Scheme
from cluster_est.methods.gradients import Derivatives, derivatives
from cluster_est.methods.known import usable, why_unusable, worst_constraint
from cluster_est.methods.linear_pieces import Piece, Pieces, is_jump
from cluster_est.methods.penalty import Penalty
from cluster_est.methods.quadratic_program import Model, penalised_step
from cluster_est.methods.threads import drive
from cluster_est.space import Space
from workers.messages import FloatArray

FIRST_RADIUS = 1.0
"""In units of each unknown's size."""
ACCEPTED, POOR, GOOD = 0.05, 0.25, 0.75
"""Of what a step promised: the least that is taken, and what shrinks and widens the region."""
SHRINK, WIDEN = 0.25, 3.0
FLOOR = 1e-16
"""A cost this much smaller than the largest seen counts as zero."""
NEARLY_OPTIMAL = 1e-3


@dataclass(frozen=True)
class Settings:
    """Options of the search; see `Sqp`."""

    max_iterations: int
    ftol: float
    xtol: float
    differences: Literal["auto", "forward", "central"]
    relative_step: float
    hessian: Hessian
    speculative_gradient: bool


def sequential_search(space: Space, settings: Settings) -> Search:
    """Minimise the cost of `space` under its bounds and constraints."""
    return _Sequential(space, settings).run()


@dataclass(frozen=True)
class _Trial:
    """A step, what the model promised of it, and what came of it.

    `promised` and `gained` are decreases of the merit; `multipliers` belong to the model.
    """

    x: FloatArray
    at: Evaluation
    step: FloatArray
    model: Model
    multipliers: FloatArray
    promised: float
    gained: float

    @property
    def ratio(self) -> float:
        return self.gained / self.promised if self.promised > 0.0 else -1.0


class _Sequential:
    """State of one search."""

    def __init__(self, space: Space, settings: Settings) -> None:
        self._space, self._settings = space, settings
        self._equality = space.equality
        self._logarithmic = np.array([unknown.log for unknown in space.unknowns], dtype=bool)
        self._scheme: Scheme = "central" if settings.differences == "central" else "forward"
        self._curvature = Curvature(settings.hessian)
        self._pieces = Pieces(self._equality, 2 * space.size)
        self._multipliers = np.zeros(len(self._equality))
        self._penalty = Penalty(self._equality)
        self._radius, self._largest = FIRST_RADIUS, 0.0
        self._ahead: tuple[FloatArray, list[Evaluation]] | None = None
        self._feasibility_only = False
        self._x = space.start
        self._sizes = space.typical
        self._at: Evaluation
        self._slopes: Derivatives
        self._slopes_at = self._x
        self._best: tuple[FloatArray, Evaluation]
        self._progress: Progress

    def run(self) -> Search:
        (at,) = yield Points(self._x[None, :], "start", Progress(0, np.nan))
        if not usable(at):
            return Solution(self._x, np.nan, Ending.START_FAILED, why_unusable(at))
        self._at, self._best, self._largest = at, (self._x, at), abs(at.cost)
        self._feasibility_only = at.residuals.size == 0
        self._progress = Progress(0, at.cost, violation=self._shown(at))
        while True:
            if self._feasibility_only and self._best[1].feasible:
                return self._solution(Ending.CONVERGED)
            yield from self._differentiate()
            if self._slopes.frozen.all():
                return self._solution(Ending.DERIVATIVES_FAILED)
            ending = self._judge()
            if ending is None:
                ending = yield from self._advance()
            if ending is not None and not self._refines(ending):
                return self._solution(ending)

    def _differentiate(self) -> Generator[Points, list[Evaluation], None]:
        """Ask for the derivatives, unless they came with the trial."""
        space, x = self._space, self._x
        self._sizes = np.where(self._logarithmic, 1.0, np.maximum(np.abs(x), space.typical))
        asking = self._derivatives(x, self._at)
        ahead, self._ahead = self._ahead, None
        if ahead is not None and np.array_equal(ahead[0], x):
            self._slopes = drive(asking, lambda points: ahead[1])
        else:
            self._slopes = yield from asking
        self._slopes_at = x
        self._curvature.at(x, self._slopes, self._multipliers, self._sizes)
        steepest = float(np.abs(self._sizes * self._slopes.gradient).max())
        self._penalty.begin(self._at.cost, steepest)

    def _derivatives(
        self, x: FloatArray, at: Evaluation
    ) -> Generator[Points, list[Evaluation], Derivatives]:
        relative = self._settings.relative_step
        return derivatives(self._space, x, at, self._scheme, relative, self._progress)

    def _judge(self) -> Ending | None:
        """Whether a bold step still promises anything."""
        model, step, _ = self._step(max(self._radius, FIRST_RADIUS))
        promised = self._penalty.promised(model, self._at, step)
        size = self._size(self._at)
        optimality = float(np.sqrt(max(promised, 0.0) / size)) if size > 0.0 else 0.0
        self._progress = replace(self._progress, optimality=optimality, damping=self._radius)
        if max(promised, abs(model.change(step))) <= self._settings.ftol * size:
            return Ending.CONVERGED
        if promised <= 0.0:
            return Ending.CONVERGED
        if self._progress.iteration >= self._settings.max_iterations:
            return Ending.MAX_ITERATIONS
        return None

    def _advance(self) -> Generator[Points, list[Evaluation], Ending | None]:
        """Try steps until one lowers the merit or the trust region is gone."""
        corrected = bent = False
        while self._radius > self._settings.xtol:
            trial = yield from self._try()
            spoiled = self._spoiled_by_constraints(trial)
            if spoiled and not corrected:
                corrected = True
                better = yield from self._correct(trial)
                if better.gained > max(trial.gained, ACCEPTED * trial.promised):
                    return self._accept(better)
            if trial.ratio >= ACCEPTED:
                return self._accept(trial)
            if spoiled and not bent and self._kinked(trial):
                bent, corrected = True, False
                yield from self._see_other_face(trial)
                continue
            self._radius = SHRINK * min(self._radius, self._length(trial.step))
        return Ending.STALLED

    def _try(self) -> Generator[Points, list[Evaluation], _Trial]:
        model, step, multipliers = self._step(self._radius)
        x = self._inside(self._x + step)
        at = yield from self._evaluate(x, "trial")
        change = at.cost - self._at.cost
        if len(self._equality) and usable(at):
            linear = self._at.constraints + self._slopes.constraints @ step
            change += float(multipliers @ (at.constraints - linear))
        self._curvature.learn(step, float(self._slopes.gradient @ step), change)
        promised = self._penalty.promised(model, self._at, step)
        return _Trial(x, at, step, model, multipliers, promised, self._gained(at))

    def _correct(self, trial: _Trial) -> Generator[Points, list[Evaluation], _Trial]:
        """A step with the same slopes, but with the constraints' values at the trial point."""
        count = len(self._equality)
        values = trial.model.values.copy()
        values[:count] = trial.at.constraints - self._slopes.constraints @ trial.step
        model = replace(trial.model, values=values)
        step, _ = penalised_step(model, self._penalty.value, *self._box(self._radius))
        x = self._inside(self._x + step)
        (at,) = yield Points(x[None, :], "correction", self._progress)
        self._note(x, at)
        return replace(trial, x=x, at=at, step=x - self._x, gained=self._gained(at))

    def _see_other_face(self, trial: _Trial) -> Generator[Points, list[Evaluation], None]:
        """Linearise the constraints where they spoiled a step, too."""
        slopes = yield from self._derivatives(trial.x, trial.at)
        self._pieces.active = True
        if not slopes.frozen.any():
            self._pieces.add(Piece(trial.x, trial.at.constraints, slopes.constraints))

    def _accept(self, trial: _Trial) -> Ending | None:
        """Move to a trial point. Returns why to stop, if so."""
        self._pieces.add(self._piece())
        length = self._length(trial.step)
        self._radius = _radius(self._radius, trial.ratio, length)
        self._x, self._at, self._multipliers = trial.x, trial.at, trial.multipliers
        self._largest = max(self._largest, abs(trial.at.cost))
        self._progress = Progress(
            self._progress.iteration + 1,
            trial.at.cost,
            step=float(np.linalg.norm(trial.step / self._space.typical)),
            optimality=self._progress.optimality,
            damping=self._radius,
            violation=self._shown(trial.at),
        )
        left = self._penalty.value * self._penalty.violations(trial.at)
        gained = max(trial.gained, trial.promised)
        if trial.at.feasible and gained + left <= self._settings.ftol * self._size(trial.at):
            return Ending.CONVERGED
        return Ending.STALLED if length <= self._settings.xtol else None

    def _refines(self, ending: Ending) -> bool:
        """Switch to central differences where forward ones are through; whether that was done."""
        optimal = ending is Ending.CONVERGED or self._progress.optimality < NEARLY_OPTIMAL
        forward = self._settings.differences == "auto" and self._scheme == "forward"
        if not (forward and optimal and ending is not Ending.MAX_ITERATIONS):
            return False
        self._scheme, self._ahead = "central", None
        self._radius = max(self._radius, 1e-2 * FIRST_RADIUS)
        return True

    def _solution(self, ending: Ending) -> Solution:
        """The point of least merit among the feasible ones, else the least violation."""
        x, at = self._best
        if self._at.feasible and self._penalty.merit(self._at) <= self._penalty.merit(at):
            x, at = self._x, self._at
        message = ""
        if ending is Ending.STALLED and self._progress.iteration > 0:
            ending = Ending.CONVERGED
            if self._progress.optimality >= NEARLY_OPTIMAL:
                message = (
                    "no step longer than xtol lowers the cost; the gradient is not zero there, as "
                    "at a kink or where simulations are noisy"
                )
        if not at.feasible:
            ended = ending in (Ending.CONVERGED, Ending.STALLED)
            ending = Ending.INFEASIBLE if ended else ending
            message = worst_constraint(self._space, at)
        jacobian = self._slopes.residuals if np.array_equal(x, self._slopes_at) else None
        return Solution(
            x=x,
            cost=at.cost,
            ending=ending,
            message=message,
            iterations=self._progress.iteration,
            jacobian=None if jacobian is None else jacobian.matrix,
            difference_steps=None if jacobian is None else jacobian.steps,
            at=at,
        )

    def _step(self, radius: float) -> tuple[Model, FloatArray, FloatArray]:
        """The model, its best step within a trust region, and the multipliers."""
        model = self._model(radius)
        return model, *self._penalty.step(model, *self._box(radius), self._sizes)

    def _model(self, radius: float) -> Model:
        slopes, count = self._slopes, len(self._equality)
        hessian = self._curvature.matrix
        if self._feasibility_only:
            hessian = np.diag(1e-4 / self._sizes**2)
        order = np.arange(count, dtype=np.intp)
        model = Model(
            slopes.gradient,
            hessian,
            self._at.constraints,
            slopes.constraints,
            order,
            self._equality,
        )
        return self._pieces.extend(model, self._x, radius * self._sizes)

    def _box(self, radius: float) -> tuple[FloatArray, FloatArray]:
        """Room of a step: the trust region and the bounds; none for frozen unknowns."""
        reach = np.where(self._slopes.frozen, 0.0, radius * self._sizes)
        lower = np.maximum(-reach, self._space.lower - self._x)
        return lower, np.minimum(reach, self._space.upper - self._x)

    def _evaluate(
        self, x: FloatArray, purpose: str
    ) -> Generator[Points, list[Evaluation], Evaluation]:
        points = x[None, :]
        if self._settings.speculative_gradient:
            ahead = next(self._derivatives(x, self._at)).x
            points = np.vstack([points, ahead])
        at, *others = yield Points(points, purpose, self._progress)
        self._ahead = (x, others) if others else None
        self._note(x, at)
        return at

    def _spoiled_by_constraints(self, trial: _Trial) -> bool:
        """Whether less than half came of a step, and most of that because constraints bend."""
        if not usable(trial.at) or trial.gained > 0.5 * trial.promised:
            return False
        excess = self._penalty.violations(trial.at) - trial.model.violation(trial.step)
        return self._penalty.value * excess > 0.5 * (trial.promised - trial.gained)

    def _kinked(self, trial: _Trial) -> bool:
        return not (
            self._equality.all() or is_jump(self._piece(), trial.step, trial.at.constraints)
        )

    def _piece(self) -> Piece:
        return Piece(self._x, self._at.constraints, self._slopes.constraints)

    def _note(self, x: FloatArray, at: Evaluation) -> None:
        if at.rank < self._best[1].rank:
            self._best = (x, at)

    def _gained(self, at: Evaluation) -> float:
        return self._penalty.merit(self._at) - self._penalty.merit(at)

    def _size(self, at: Evaluation) -> float:
        """What changes of the merit are compared with."""
        size = max(abs(at.cost), FLOOR * self._largest)
        return size if at.feasible else size + self._penalty.value * self._penalty.violations(at)

    def _length(self, step: FloatArray) -> float:
        return float(np.max(np.abs(step / self._sizes)))

    def _inside(self, x: FloatArray) -> FloatArray:
        return np.clip(x, self._space.lower, self._space.upper)

    def _shown(self, at: Evaluation) -> float:
        return at.violation if len(self._equality) else np.nan


def _radius(radius: float, ratio: float, length: float) -> float:
    """The next trust radius."""
    if ratio < POOR:
        return SHRINK * min(radius, length)
    if ratio >= GOOD and length >= 0.8 * radius:
        return WIDEN * radius
    return radius
