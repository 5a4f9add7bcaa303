"""Simulations that derivatives need besides those of the search: few, and on the same queue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Method, Points, Search, Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.derivatives.differences import jacobian, relative_noise
from cluster_est.problem.space import SearchSpace
from cluster_est.running.runner import Runner, SearchRequest
from cluster_est.uncertainty.covariance.accuracy import sizes
from cluster_est.uncertainty.covariance.covariance import assess, prepare
from cluster_est.uncertainty.covariance.jacobian import has_slopes, slopes_of, with_slopes
from cluster_est.uncertainty.covariance.result import Uncertainty
from cluster_est.uncertainty.covariance.system import ScaledJacobian, vectors
from cluster_est.uncertainty.spaces import moved
from workers.messages import FloatArray

LEAST_REACH, LARGEST_REACH = 1e-3, 3e-2
SUSPECT = 1e-2
"""Directions up to this ratio are measured again. A kink in an equation, such as a dead zone's,
makes an adaptive solver's result jump by more than its tolerance; over the step of a difference
that looks as if the data determined, badly, what they do not determine at all.
"""
ROUNDS = 3
FALLEN = 0.1
"""Part of its ratio, below which a direction has turned so far that it is measured once more."""


def examine(runner: Runner, space: SearchSpace, solution: Solution) -> Uncertainty:
    """What the data say about a solution to first order, with the simulations that this takes.

    A solution without derivatives costs a central Jacobian. Directions in which the residuals seem
    not to change cost four points each: along those the derivative is measured once more, with
    steps so long that the sum of the columns' errors does not hide it.

    Parameters
    ----------
    runner
        Where they run.
    space, solution
        What was searched, and what was found.
    """
    solution = linearise(runner, space, solution)
    sharp, reach = sharpen(runner, space, solution)
    found = assess(space, sharp, reach)
    if not found.directions or reach > 0.0:
        return found
    note = (
        "what is said of directions was not confirmed by simulations, because some failed close "
        "to the solution or bounds left no room for them"
    )
    return replace(found, notes=(*found.notes, note))


def linearise(runner: Runner, space: SearchSpace, solution: Solution) -> Solution:
    """The solution with its evaluation and its Jacobian, simulated where they are missing.

    It is as it was where the simulations fail.
    """
    if not np.isfinite(solution.cost):
        return solution
    if has_slopes(solution) and solution.at is not None:
        return solution
    asked = _CentralJacobian(not has_slopes(solution))
    here = moved(space, solution.x)
    (found,) = runner.run([SearchRequest("derivatives", asked, here)])
    if not found.ending.success:
        return solution
    solution = replace(solution, cost=found.cost, at=found.at)
    if has_slopes(solution):
        return solution
    return replace(
        solution,
        jacobian=found.jacobian,
        block_jacobian=found.block_jacobian,
        difference_steps=found.difference_steps,
    )


def sharpen(runner: Runner, space: SearchSpace, solution: Solution) -> tuple[Solution, float]:
    """Measure again along the directions in which the residuals hardly change.

    Returns
    -------
    solution
        With a Jacobian whose products with these directions are the measured ones.
    reach
        The relative step that was used; 0 if there was nothing to measure or it failed.
    """
    system, reach = prepare(space, solution, weak=SUSPECT), 0.0
    for _ in range(ROUNDS):
        if system is None or not system.bad:
            break
        found = _measured(runner, space, solution, system)
        if found is None:
            break
        solution, reach = found
        least = min(direction.ratio for direction in system.bad)
        system = prepare(space, solution, reach, SUSPECT)
        if system is None or not any(not c.lost and c.ratio < FALLEN * least for c in system.bad):
            break
    return solution, reach


def _measured(
    runner: Runner, space: SearchSpace, solution: Solution, system: ScaledJacobian
) -> tuple[Solution, float] | None:
    """The solution with measured slopes along bad directions, and the step; None if it fails."""
    matrix = slopes_of(space, solution)
    assert matrix is not None
    found = vectors(space, system.unheld, system.bad)
    scaled = np.asarray(np.linalg.qr(found.T)[0])
    moves = scaled.T / system.scale
    lengths, reach = _lengths(space, solution.x, moves)
    own = (
        0.0
        if solution.difference_steps is None
        else float(
            np.max(np.abs(solution.difference_steps) / sizes(space, solution.x), initial=0.0)
        )
    )
    if reach <= own:
        return None
    asked = _DirectionalDifferences(moves * lengths[:, None])
    here = moved(space, solution.x)
    (measured,) = runner.run([SearchRequest("directions", asked, here)])
    if measured.jacobian is None or solution.at is None:
        return None
    slopes = measured.jacobian / lengths
    return with_slopes(solution, _corrected(matrix, system, scaled, slopes)), reach


def _lengths(space: SearchSpace, x: FloatArray, moves: FloatArray) -> tuple[FloatArray, float]:
    """How far to go along each direction, and the least relative change that this makes."""
    noise = relative_noise(space.problem.model.solver)
    reach = min(max(noise**0.2, LEAST_REACH), LARGEST_REACH)
    largest = np.max(np.abs(moves) / sizes(space, x), axis=1)
    room = np.minimum(space.upper - x, x - space.lower)
    with np.errstate(divide="ignore"):
        most = np.min(np.where(moves != 0.0, room / np.abs(moves), np.inf), axis=1)
    lengths = np.minimum(reach / largest, most)
    return lengths, float(np.min(lengths * largest))


def _corrected(
    matrix: BlockMatrix, system: ScaledJacobian, directions: FloatArray, slopes: FloatArray
) -> BlockMatrix:
    """The least change of the Jacobian that gives the measured slopes, experiment by experiment.

    Columns of unknowns that do not act on an experiment stay 0 there.
    """
    parts = []
    for own, acting, rows in zip(matrix.parts, matrix.columns, matrix.rows, strict=True):
        part = directions[acting]
        scaled = own / system.scale[acting]
        change = (slopes[rows] - scaled @ part) @ np.linalg.pinv(part, rcond=1e-8)
        parts.append((scaled + change) * system.scale[acting])
    return replace(matrix, parts=tuple(parts))


@dataclass(frozen=True)
class _CentralJacobian(Method):
    """Evaluate the start and, if asked, a central Jacobian there."""

    name: ClassVar[str] = "derivatives"
    needs_residuals: ClassVar[bool] = False

    derivatives: bool

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        x = space.start
        (at,) = yield Points(x[None, :], "start")
        if not at.ok:
            return Solution(x, np.nan, Ending.START_FAILED, at.reason)
        if not self.derivatives:
            return Solution(x, at.cost, Ending.CONVERGED, at=at)
        found = yield from jacobian(space, x, at, "central", 0.0, None)
        ending = Ending.DERIVATIVES_FAILED if found.frozen.all() else Ending.CONVERGED
        return Solution(
            x,
            at.cost,
            ending,
            jacobian=found.whole,
            block_jacobian=found.large,
            difference_steps=found.steps,
            at=at,
        )


@dataclass(frozen=True)
class _DirectionalDifferences(Method):
    """Slopes of the residuals along some steps from the start, of fourth order.

    Attributes
    ----------
    steps : (directions, unknowns)
        Each is gone forwards and backwards, whole and by half.
    """

    name: ClassVar[str] = "directions"
    needs_residuals: ClassVar[bool] = True

    steps: FloatArray = field(repr=False)

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        x = space.start
        parts = [x + share * self.steps for share in (1.0, -1.0, 0.5, -0.5)]
        points = np.clip(np.vstack(parts), space.lower, space.upper)
        found = yield Points(points, "direction")
        if not all(evaluation.ok for evaluation in found):
            return Solution(x, np.nan, Ending.DERIVATIVES_FAILED)
        slopes = np.column_stack([self._slope(found, j) for j in range(len(self.steps))])
        return Solution(x, np.nan, Ending.CONVERGED, jacobian=slopes)

    def _slope(self, found: Sequence[Evaluation], j: int) -> FloatArray:
        """Richardson's extrapolation of two central differences."""
        ahead, behind, near, back = (found[j + q * len(self.steps)].residuals for q in range(4))
        whole, half = (ahead - behind) / 2.0, near - back
        return np.asarray((4.0 * half - whole) / 3.0)
