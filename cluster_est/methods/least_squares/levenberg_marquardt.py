"""A Levenberg-Marquardt method within bounds and constraints, for parallel evaluations.

An iteration is two requests: one point for each colour of unknowns (the Jacobian), then steps for
several damping factors at the same time, of which the best is taken. The number of trial steps is
an option and never the number of workers, so the result does not depend on the machine. Where the
predicted reduction is far above the best actual one, a third request follows the curvature that
the trials have shown. In place of the first one may stand Broyden's update of the last Jacobian by
what its step has shown, which costs no simulation:

    J+ = J + (dr - J p) (D^2 p)' / (p' D^2 p)

is the least change, in the scaled norm, with which J+ p = dr, the change of the residuals that was
seen (C. G. Broyden, Math. Comp. 19 (1965) 577-593, doi:10.1090/S0025-5718-1965-0198670-6).

Each step minimises the linear model within the bounds exactly, so a bound that becomes active does
not bend the step of the other unknowns. Damping is scaled by the largest column norms so far, which
makes the iterates independent of the units of the unknowns.

A minimum is flat: at half of a double's digits in the unknowns all digits of the cost are used up.
The gradient has more of them. So the last steps, where changes of the cost are rounding errors, are
full steps, one point at a time, as long as they do not raise the cost by more than counts as no
change. Gauss-Newton steps approach a minimum with large residuals only linearly; two of them in a
row are extrapolated by Anderson's formula of depth one (H. F. Walker, P. Ni, SIAM J. Numer. Anal.
49 (2011) 1715-1735, doi:10.1137/10078356X).

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
"""Part of `ftol` below which the relative reduction ends the search."""
LARGEST_FACTOR = 10.0
"""Most by which the extrapolation may lengthen a step."""


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
"""Distance of the change that was expected from the one that was seen, over the latter, above which
derivatives are computed anew."""


def secant_update(
    jacobian: ResidualJacobian, before: IterationState, after: IterationState
) -> ResidualJacobian | None:
    """Return the Jacobian after a step; None where it does not say what the step has shown.

    Parameters
    ----------
    jacobian
        At the point before.
    before, after
        The step.
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
"""An unknown this much smaller than its start gets smaller differences at the end."""
MATTERS = 1e-3
"""Change of the residuals, over their size, that an unknown makes when it changes by its own size,
below which its derivative does not matter."""
DOUBTED = (Ending.CONVERGED, Ending.STALLED, Ending.NO_EFFECT)
"""Endings that better derivatives may show to be none."""
NO_ROOM = "the budget was too small for more accurate derivatives"
CONSTRAINED_XTOL = 1e-6
"""Shortest step under constraints; at their kinks the cost stops falling long before it."""


@dataclass(frozen=True)
class LeastSquares(Method):
    """Levenberg-Marquardt with coloured differences and parallel trial steps.

    The method to try first for any sum of squares, and for the costs that weight them: few
    evaluations, and each request keeps many workers busy. It finds the minimum that the start leads
    to; for others use several starts. It keeps bounds at every point. Under constraints of other
    kinds its Gauss-Newton model goes through the steps of `sqp`, and they are satisfied in the end.
    Not for costs without weights, or with jumps. It asks for no Jacobian if a budget of evaluations
    has no room for a step that follows: to the end it corrects the last one by its steps.

    Attributes
    ----------
    trials
        Steps that are tried at once, each with ten times the damping of the one before. Without
        effect under constraints.
    max_iterations
        Limit on the number of Jacobians, corrected ones among them.
    ftol, xtol, gtol
        Converged when the model expects to lower the cost by less than `ftol` of the weighted sum
        of squares, when a step is shorter than `xtol` of the point, or when the cosine between the
        residuals and every column of the Jacobian that is not held by a bound is below `gtol`.
    differences
        "forward", "central", or "auto": forward until converged, then central to the end, which
        removes the error that forward differences leave in the minimum; where no step lowers the
        cost, though they promise it, with longer steps, as for simulations that are noisier than
        their solver lets expect. Where they are central, the last steps go on to a millionth of
        `ftol`. "sensitivities": none; one simulation carries the
        derivatives along, where an FMU in model exchange provides directional derivatives that
        agree with differences, and "auto" elsewhere. `cluster-est check` says where they are
        quicker; nothing else takes them.
    relative_step
        Relative step of the differences; 0 takes the one that suits the solver's noise.
    secant_updates
        How many times in a row the derivatives of the next point may be those of the last one,
        corrected by what its step has shown, in place of new ones: for expensive simulations on few
        workers, with some ten unknowns or more in each experiment. Derivatives are computed anew
        where they do not suit, and before it ends. Without effect under constraints.
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

    def search_briefly(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        """Start a search that computes no derivatives at the point where its iterations run out.

        The derivatives of its result are then those of the point before, corrected by the last step
        if `secant_updates` allows it.
        """
        constrained = bool(space.constraint_names)
        return self.search(space, generator) if constrained else self._free(space, brief=True)

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

    def _free(self, space: SearchSpace, *, brief: bool = False) -> Search:
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
        before: _End | None = None  # where shorter differences ended
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
                enough = brief and ending is Ending.MAX_ITERATIONS
                if (secant is not None and not enough) or unknown:
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
        """Go from a Jacobian to the next point. Return the new state, and the ending if any."""
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
    """An end of the search, with the derivatives that led there, and what is to be said of them."""

    state: IterationState
    jacobian: ResidualJacobian | None
    ending: Ending
    note: str

    def better_than(self, before: _End | None) -> _End:
        """Return this end, or the one before if hardly anything is gained.

        That has shorter differences, which are those of a point that is as good as this one.
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
    """Return the last Jacobian, corrected by its step, where a budget has no room for a new one.

    None at an end that only better derivatives could confirm, or where the step contradicts it.
    """
    if before is None or compared is not None:
        return None
    return secant_update(*before, state)


def _without_room(end: _End, before: _End | None) -> _End:
    """Return the end where a budget has no room for derivatives and a step that follows.

    An end that has derivatives stays one, though there is no room for better ones.
    """
    if end.jacobian is None:
        return replace(end, ending=Ending.BUDGET)
    note = f"{end.note}; {NO_ROOM}" if end.note else NO_ROOM
    return replace(end, note=note).better_than(before)


def _disagree(
    space: SearchSpace, state: IterationState, one: ResidualJacobian, other: ResidualJacobian
) -> bool:
    """Return whether two Jacobians by different differences differ by more than half in a column.

    Then both are the noise of simulations, or a kink. Columns of unknowns that hardly matter are
    left out, as is everything where nothing is left of the residuals.
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
    """Return the state without the sizes of columns that were noise."""
    damping = min(state.damping, INITIAL_DAMPING)
    return replace(state, damping=damping, largest=np.zeros(len(state.x)))


def _with_current_sizes(space: SearchSpace, x: FloatArray) -> SearchSpace:
    """Return the space, for differences, with starts as small as unknowns have become."""
    small = (np.abs(x) < SHRUNK_UNKNOWN * space.typical) & (space.start != 0.0)
    size = np.maximum(np.abs(x), SHRUNK_UNKNOWN**2 * space.typical)
    start = np.where(small, np.copysign(size, x), space.start)
    return space.starting_at(np.clip(start, space.lower, space.upper))
