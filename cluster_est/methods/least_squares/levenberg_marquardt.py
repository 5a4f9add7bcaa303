"""A Levenberg-Marquardt method within bounds and constraints, for parallel evaluations.

An iteration has two requests. The first one evaluates a point for each colour of unknowns, for the
Jacobian. The second one evaluates the steps of several damping factors at the same time, and the
best step is taken. The number of trial steps is an option and does not depend on the number of
workers, so the result does not depend on the machine. If the predicted reduction is far above the
best actual one, a third request tries steps that follow the curvature shown by the trials. Instead
of a new Jacobian, Broyden's update of the last one can be used, which needs no simulation:

    J+ = J + (dr - J p) (D^2 p)' / (p' D^2 p)

This is the least change, in the scaled norm, with which J+ p = dr, where dr is the change of the
residuals by the step p (C. G. Broyden, Math. Comp. 19 (1965) 577-593,
doi:10.1090/S0025-5718-1965-0198670-6).

Each step minimises the linear model within the bounds exactly, so an active bound does not change
the direction of the other unknowns. Damping is scaled by the largest column norms so far. This
makes the iterates independent of the units of the unknowns.

Near a minimum, the cost is flat: it no longer changes in any digit while the unknowns still change
in half of theirs. The gradient is more accurate. So the last steps, in which changes of the cost
are rounding errors, are full steps, one point at a time, as long as the cost does not rise
noticeably. If the residuals are large, Gauss-Newton steps converge only linearly. Two of them in a
row are therefore extrapolated by Anderson's formula of depth one (H. F. Walker, P. Ni, SIAM J.
Numer. Anal. 49 (2011) 1715-1735, doi:10.1137/10078356X).

References: D. W. Marquardt, J. SIAM 11 (1963) 431-441, doi:10.1137/0111030; J. J. More, The
Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978), doi:10.1007/BFb0067700.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.differences import Differences, ResidualJacobian
from cluster_est.methods.gradients import JacobianProvider
from cluster_est.methods.least_squares.iteration import (
    LEAST_DAMPING,
    REDUCTION_NEAR_MINIMUM,
    SHORTEST_SECANT,
    IterationState,
    LeastSquaresIteration,
    Result,
    Steps,
    enough_to_notice,
)
from cluster_est.methods.least_squares.linear_map import LocalModel
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
    within_budget,
)
from cluster_est.methods.sqp.sqp import Sqp
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

FINAL_PART = 1e-6
"""The search ends if the relative reduction is below this part of `ftol`."""
LARGEST_FACTOR = 10.0
"""Largest factor by which the extrapolation may lengthen a step."""


def final_step(
    space: SearchSpace, state: IterationState, model: LocalModel, ftol: float
) -> Generator[Points, list[Evaluation], Result | None]:
    """Take the full step. Return None if the point is not close, or the step raises the cost."""
    step = model.step(LEAST_DAMPING)
    reduction = model.predicted_reduction(step) / model.squares if model.squares > 0.0 else np.inf
    if reduction > REDUCTION_NEAR_MINIMUM:
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


WORST = 0.95
"""Largest deviation of the expected change of the residuals from the actual change, relative to the
actual change. Above it, derivatives are computed by simulations."""


def secant_update(
    jacobian: ResidualJacobian, before: IterationState, after: IterationState
) -> ResidualJacobian | None:
    """Return the Jacobian after a step; None if it contradicts the result of the step.

    Parameters
    ----------
    jacobian
        The Jacobian at the point before the step.
    before, after
        The states before and after the step.
    """
    blocks, step = jacobian.blocks, after.x - before.x
    seen = after.at.residuals - before.at.residuals
    missed = seen - blocks.product(step)
    if not np.linalg.norm(missed) <= WORST * np.linalg.norm(seen):
        return None
    direction = before.largest**2 * step if before.largest.any() else step
    parts, least = [], SHORTEST_SECANT * float(direction @ step)
    for block, columns, rows in zip(blocks.blocks, blocks.columns, blocks.rows, strict=True):
        length = float(direction[columns] @ step[columns])
        change = np.outer(missed[rows], direction[columns]) / length if length > least else 0.0
        parts.append(block + change)
    return replace(jacobian, blocks=BlockMatrix(tuple(parts), blocks.columns, blocks.size))


INITIAL_DAMPING = 1e-3
SHRUNK_UNKNOWN = 0.1
"""Unknowns below this part of their start value get shorter difference steps at the end."""
MATTERS = 1e-3
"""Smallest relative change of the residuals, if an unknown changes by its own size, at which the
derivative of this unknown matters."""
DOUBTED = (Ending.CONVERGED, Ending.STALLED, Ending.NO_EFFECT)
"""Endings that are confirmed with more accurate derivatives."""
NO_ROOM = "the budget was too small for more accurate derivatives"
CONSTRAINED_XTOL = 1e-6
"""Shortest step under constraints. At kinks of constraints, the cost stops falling earlier."""


@dataclass(frozen=True)
class LeastSquares(Method):
    """Levenberg-Marquardt with coloured differences and parallel trial steps.

    Try this method first for any sum of squares, and for costs with weights. It needs few
    evaluations, and each request keeps many workers busy. It finds the local minimum near the
    start; use several starts for other minima. It keeps bounds at every point. With constraints of
    other kinds, its Gauss-Newton model is used in the steps of `sqp`, and the constraints are
    satisfied at the end. It is not suitable for costs without weights or with jumps. If the budget
    of evaluations has no room for a Jacobian and a step, the last Jacobian is updated instead.

    Attributes
    ----------
    trials
        Number of steps that are tried at once, each with ten times the damping of the one before.
        No effect with constraints.
    max_iterations
        Largest number of Jacobians, including updated ones.
    ftol, xtol, gtol
        The search has converged if the model predicts a reduction of the cost below `ftol` times
        the weighted sum of squares, if a step is shorter than `xtol` times the point, or if the
        cosine between the residuals and each column of the Jacobian is below `gtol`. Columns of
        unknowns at a bound do not count.
    differences
        "forward", "central", "auto" or "sensitivities". "auto" uses forward differences until
        convergence and then central differences, which removes the error of forward differences
        from the minimum. If no step lowers the cost as predicted, "auto" uses longer difference
        steps, because the simulations may be noisier than their solver suggests. With central
        differences, the last steps continue to a millionth of `ftol`. "sensitivities" uses none:
        one simulation also integrates the derivatives. This needs an FMU in model exchange whose
        directional derivatives agree with differences; otherwise it is the same as "auto".
        `cluster-est check` reports where sensitivities are faster; they are never used by default.
    relative_step
        Relative step of the differences; 0 selects the step that suits the noise of the solver.
    secant_updates
        Largest number of Jacobians in a row that are updates of the one before, instead of new
        ones. Useful for expensive simulations on few workers, with about ten or more unknowns in
        each experiment. Derivatives are computed by simulations if an update does not suit, and
        before the search ends. No effect with constraints.
    """

    name: ClassVar[str] = "least_squares"
    needs_residuals: ClassVar[bool] = True
    keeps_constraints: ClassVar[bool] = True

    trials: int = field(default=4, metadata={"least": 1})
    max_iterations: int = field(default=100, metadata={"least": 1})
    ftol: float = field(default=1e-10, metadata={"least": 0.0})
    xtol: float = field(default=1e-10, metadata={"least": 0.0})
    gtol: float = field(default=1e-10, metadata={"least": 0.0})
    differences: Differences = "auto"
    relative_step: float = field(default=0.0, metadata={"least": 0.0})
    secant_updates: int = field(default=0, metadata={"least": 0})

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        if not space.constraint_names:
            return self._free(space)
        constrained = Sqp(
            max_iterations=self.max_iterations,
            ftol=self.ftol,
            xtol=max(self.xtol, CONSTRAINED_XTOL),
            differences=self.differences,
            relative_step=self.relative_step,
            hessian="gauss_newton",
        )
        return constrained.search(space, generator)

    def _free(self, space: SearchSpace) -> Search:
        x = space.start
        (at,) = yield Points(x[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(x, np.nan, Ending.START_FAILED, at.reason)
        state = IterationState(
            x,
            at,
            Progress(0, at.cost),
            np.zeros(space.size),
            INITIAL_DAMPING,
            start_cost=at.cost,
        )
        provider = JacobianProvider(space, self.differences, self.relative_step)
        compared: ResidualJacobian | None = None
        before: _End | None = None  # the end with shorter differences
        ended = Ending.CONVERGED
        secant, updates, most = None, 0, self.secant_updates
        before_step: tuple[ResidualJacobian, IterationState] | None = None
        while True:
            refined = provider.exact or compared is not None
            scaled = _with_current_sizes(space, state.x) if refined else space
            requests = provider.jacobian(scaled, state.x, state.at, state.progress)
            jacobian = secant or (yield from within_budget(requests, 1))
            if jacobian is None:
                secant = _corrected(before_step, state, compared)
                if secant is None:
                    end = _End(state, compared, ended, provider.note)
                    return _without_room(end, before).solution(space)
                jacobian = secant
            doubtful = compared is not None and _disagree(scaled, state, compared, jacobian)
            end = _End(state, jacobian, ended, provider.note)
            if not (doubtful and provider.lengthen()):
                exact = provider.exact and secant is None
                last, (state, ending) = (
                    state,
                    (yield from self._iterate(space, state, jacobian, exact)),
                )
                if ending is None:
                    compared, before_step = None, (jacobian, last)
                    updates = 0 if secant is None else updates
                    updated = updates < most and not jacobian.frozen.any()
                    secant = secant_update(jacobian, last, state) if updated else None
                    updates += 1
                    continue
                unknown = ending in DOUBTED and jacobian.frozen.any() and state.x is not last.x
                if secant is not None or unknown:
                    # an end must be one by the derivatives of its own point
                    most = 0 if secant is not None else most
                    secant, compared, before_step = None, None, None
                    state = replace(state, damping=min(state.damping, INITIAL_DAMPING))
                    continue
                ended = ending
                if ending in DOUBTED and provider.refine():
                    compared = jacobian
                    state = replace(state, damping=min(state.damping, INITIAL_DAMPING))
                    continue
                end = _End(state, jacobian, ending, provider.note)
                unsettled = ending in (Ending.STALLED, Ending.NO_EFFECT)
                if not (unsettled and provider.lengthen()):
                    return end.better_than(before).solution(space)
            before = end.better_than(before)
            compared, state = jacobian, _without_scales(state)

    def _iterate(
        self, space: SearchSpace, state: IterationState, jacobian: ResidualJacobian, exact: bool
    ) -> Steps:
        """Take a step with a Jacobian. Return the new state, and the ending if there is one."""
        if jacobian.frozen.all():
            return state, Ending.DERIVATIVES_FAILED
        model = LocalModel(space, state.x, state.at, jacobian, state.largest)
        if model.squares == 0.0:
            return state, Ending.PERFECT
        if not jacobian.blocks.norms().any():
            return state, Ending.NO_EFFECT
        progress = replace(state.progress, optimality=model.optimality, damping=state.damping)
        state = replace(state, largest=model.scale, progress=progress)
        if model.optimality <= self.gtol:
            return state, Ending.CONVERGED
        if state.progress.iteration >= self.max_iterations:
            return state, Ending.MAX_ITERATIONS
        if exact:
            final = yield from final_step(space, state, model, self.ftol)
            if final is not None:
                return final
        reduction = model.predicted_reduction(model.step(LEAST_DAMPING)) / model.squares
        state = replace(state, relative_reduction=reduction)
        iteration = LeastSquaresIteration(space, self.trials, self.ftol, self.xtol)
        return (yield from iteration.iterate(state, model))


@dataclass(frozen=True)
class _End:
    """An end of a search, with its last Jacobian and a note about the differences."""

    state: IterationState
    jacobian: ResidualJacobian | None
    ending: Ending
    note: str

    def better_than(self, before: _End | None) -> _End:
        """Return this end, or the one before if this end is hardly better.

        The end before has shorter differences, so its derivatives are more accurate.
        """
        if before is None or self.ending not in DOUBTED:
            return self
        enough = enough_to_notice(before.state.at)
        gained = self.state.at.cost < (1.0 - enough) * before.state.at.cost
        settled = self.ending.success and not before.ending.success
        return self if gained or settled else replace(before, state=self.state)

    def solution(self, space: SearchSpace) -> Solution:
        state, ending, note, jacobian = self.state, self.ending, self.note, self.jacobian
        found = Solution(
            x=state.x,
            cost=state.at.cost,
            ending=ending,
            message=note if ending.success or not note else f"{ending}; {note}",
            iterations=state.progress.iteration,
            at=state.at,
        )
        return found if jacobian is None else jacobian.added_to(found, space)


def _corrected(
    before: tuple[ResidualJacobian, IterationState] | None,
    state: IterationState,
    compared: ResidualJacobian | None,
) -> ResidualJacobian | None:
    """Return the updated last Jacobian, for a budget without room for a new one.

    None at an end that needs more accurate derivatives, or if the step contradicts the Jacobian.
    """
    if before is None or compared is not None:
        return None
    return secant_update(*before, state)


def _without_room(end: _End, before: _End | None) -> _End:
    """Return the end if a budget has no room for derivatives and a step.

    An end that has derivatives is kept, although there is no room for more accurate ones.
    """
    if end.jacobian is None:
        return replace(end, ending=Ending.BUDGET)
    note = f"{end.note}; {NO_ROOM}" if end.note else NO_ROOM
    return replace(end, note=note).better_than(before)


def _disagree(
    space: SearchSpace, state: IterationState, one: ResidualJacobian, other: ResidualJacobian
) -> bool:
    """Return whether two Jacobians by different differences differ by more than half in a column.

    Then both Jacobians show the noise of simulations, or a kink. Columns of unknowns that hardly
    matter are not compared, and nothing is compared if the residuals are nearly zero.
    """
    if state.exhausted or one.dense_if_small is None or other.dense_if_small is None:
        return False
    size = np.maximum(np.abs(state.x), space.typical)
    lengths = [np.linalg.norm(jacobian.matrix, axis=0) for jacobian in (one, other)]
    longest = np.maximum(*lengths)
    matters = longest * size > MATTERS * float(np.linalg.norm(state.at.residuals))
    matters &= ~(one.frozen | other.frozen)
    apart = np.linalg.norm(one.matrix - other.matrix, axis=0)
    return bool(np.any(matters & (apart > 0.5 * longest)))


def _without_scales(state: IterationState) -> IterationState:
    """Return the state without the column norms, which were noise."""
    damping = min(state.damping, INITIAL_DAMPING)
    return replace(state, damping=damping, largest=np.zeros(len(state.x)))


def _with_current_sizes(space: SearchSpace, x: FloatArray) -> SearchSpace:
    """Return the space with smaller start values for unknowns that have become small."""
    small = (np.abs(x) < SHRUNK_UNKNOWN * space.typical) & (space.start != 0.0)
    size = np.maximum(np.abs(x), SHRUNK_UNKNOWN**2 * space.typical)
    start = np.where(small, np.copysign(size, x), space.start)
    return space.starting_at(np.clip(start, space.lower, space.upper))
