"""A few further simulations for derivatives at a solution, on the same queue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.special import stdtrit
from typing_extensions import override

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.differences import jacobian, relative_noise
from cluster_est.methods.method import Ending, Evaluation, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty.covariance.accuracy import relative_sizes
from cluster_est.uncertainty.covariance.covariance import assess, not_assessed, scaled_jacobian
from cluster_est.uncertainty.covariance.local_uncertainty import Uncertainty
from cluster_est.uncertainty.covariance.normal_equations import (
    active_bounds,
    has_jacobian,
    jacobian_blocks,
    with_jacobian,
)
from cluster_est.uncertainty.covariance.system import ROUNDING_OF_DIRECTION, ScaledJacobian, vectors
from cluster_est.uncertainty.spaces import with_start
from workers.messages import FloatArray

LEAST_STEP, LARGEST_STEP = 1e-3, 3e-2
SUSPECT = 1e-2
"""Largest ratio of directions that are measured again. A kink in an equation, such as that of a
dead zone, makes the result of an adaptive solver jump by more than its tolerance. Over the step of
a difference, an undetermined direction then looks badly determined.
"""
DIRECTIONAL_STEP_LENGTHS = (1.0, 0.9, 0.7)
"""Relative lengths of directional steps, tried in this order because simulations may fail."""
MOST_DIRECTION_ROUNDS = 3
REPEATED_RATIO = 0.1
"""Share of its old ratio below which a direction is measured again."""


def examine(runner: Runner, space: SearchSpace, solution: Solution) -> Uncertainty:
    """Return the uncertainty of a solution to first order, with the necessary simulations.

    A solution without derivatives needs a central Jacobian. Each direction along which the
    residuals hardly change needs four points. The derivative along it is measured again, with a
    step that is long compared with the errors of the columns.

    Parameters
    ----------
    runner
        Runs the simulations.
    space, solution
        The search space, and the solution.
    """
    solution = linearise(runner, space, solution)
    sharp, step = sharpen(runner, space, solution)
    found = assess(space, sharp, step)
    if not found.directions or (step > 0.0).all():
        return found
    note = (
        "the statements on parameters that the data hardly determine come from derivatives only: "
        "they could not be checked by simulations near the solution, because simulations failed or "
        "the bounds are too close"
    )
    return replace(found, notes=(*found.notes, note))


def assess_held_out(
    runner: Runner,
    test: tuple[SearchSpace, Solution],
    train: tuple[SearchSpace, Solution, Uncertainty],
) -> Uncertainty:
    """Return the uncertainty of the unknowns that belong to held-out experiments alone.

    These unknowns y are fitted with the shared unknowns x fixed at their estimates from the
    training experiments. With the derivatives A and B of the held-out residuals with respect to x
    and y, an error dx changes the fit by dy = -B^+ A dx. So B^+ A C A' B^+' is added to the
    covariance from the held-out noise, where C is the covariance of x. The half widths of both
    intervals are added as squares, because their degrees of freedom differ. There is no interval
    if the derivatives are not known, or if y depends on a shared unknown without an interval.

    Parameters
    ----------
    runner
        Runs the simulations for A and B.
    test, train
        The search space and the solution of the held-out and of the training experiments, and the
        uncertainty of the latter.
    """
    (space, solution), (fixed, x, trained) = test, train
    found = assess(space, solution)
    response = _response_to_shared(runner, test, train)
    if response is None:
        return not_assessed(space, solution, "the derivatives by the shared unknowns failed")
    errors = _errors(fixed, x.x, trained)
    own_errors = _errors(space, solution.x, found)
    widths = [
        float(stdtrit(each.basis_degrees, 0.975)) if each.basis_degrees > 0 else np.nan
        for each in (found, trained)
    ]
    shared = {label: k for k, label in enumerate(trained.shared)}
    acting = np.abs(response) > NO_RESPONSE * np.abs(response).max(initial=0.0)
    intervals = []
    for i, known in enumerate(found.intervals):
        chosen = np.flatnonzero(acting[i]).tolist()
        position = [shared.get(fixed.unknowns[j].label, -1) for j in chosen]
        more = np.nan
        if min(position, default=0) >= 0:
            part = response[i, chosen] * errors[chosen]
            correlations = trained.correlations[np.ix_(position, position)]
            square = float(np.dot(part, correlations @ part))
            more = float(np.sqrt(max(square, 0.0))) if np.isfinite(square) else np.nan
        error = float(np.hypot(own_errors[i], more))
        more_of_half = widths[1] * more if chosen else 0.0
        half = float(np.hypot(widths[0] * own_errors[i], more_of_half))
        unknown, at = space.unknowns[i], float(solution.x[i])
        intervals.append(
            replace(
                known,
                std_error=error * (unknown.to_physical(at) if unknown.log else 1.0),
                lower95=unknown.to_physical(at - half),
                upper95=unknown.to_physical(at + half),
                error_white=np.nan,
                error_autoregression=np.nan,
                error_experiments=np.nan,
                error_uniform=np.nan,
            )
        )
    return replace(found, intervals=tuple(intervals))


NO_RESPONSE = 1e-9
"""Largest response that counts as rounding, relative to the largest response."""


def _response_to_shared(
    runner: Runner,
    test: tuple[SearchSpace, Solution],
    train: tuple[SearchSpace, Solution, Uncertainty],
) -> FloatArray | None:
    """Return the change of held-out unknowns with each unknown of the training space, -B^+ A.

    Unknowns at a bound are constant: there is no response of them or to them. The result is None
    if the derivatives cannot be computed.
    """
    (space, solution), (fixed, known, _) = test, train
    values = fixed.estimates(known.x) | space.estimates(solution.x)
    joint = make_space(space.problem, space.experiments, starts=values)
    labels = {unknown.label: i for i, unknown in enumerate(joint.unknowns)}
    bounds = [active_bounds(space, solution.x), active_bounds(fixed, known.x)]
    own, shared = (
        [i for i, unknown in enumerate(each.unknowns) if unknown.label in labels and not held[i]]
        for each, held in zip((space, fixed), bounds, strict=True)
    )
    response = np.zeros((space.size, fixed.size))
    if not own or not shared:
        return response
    found = linearise(runner, joint, Solution(joint.start, 0.0, Ending.CONVERGED))
    matrix = jacobian_blocks(joint, found) if has_jacobian(found) else None
    if matrix is None or (found.frozen is not None and found.frozen.any()):
        return None
    dense = matrix.dense()
    b = dense[:, [labels[space.unknowns[i].label] for i in own]]
    a = dense[:, [labels[fixed.unknowns[i].label] for i in shared]]
    sizes = np.linalg.norm(b, axis=0)
    sizes[~(sizes > 0.0)] = 1.0
    changes = np.linalg.lstsq(b / sizes, a, rcond=1e-8)[0] / sizes[:, None]
    response[np.ix_(own, shared)] = -changes
    return response


def _errors(space: SearchSpace, x: FloatArray, found: Uncertainty) -> FloatArray:
    """Return the standard error of each unknown in search coordinates."""
    units = [u.to_physical(float(x[i])) if u.log else 1.0 for i, u in enumerate(space.unknowns)]
    errors = np.array([each.std_error for each in found.intervals])
    return np.asarray(errors / np.array(units), np.float64)


def linearise(runner: Runner, space: SearchSpace, solution: Solution) -> Solution:
    """Return the solution with its evaluation and its Jacobian; simulate if they are missing.

    If the simulations fail, the solution is returned unchanged.
    """
    if not np.isfinite(solution.cost):
        return solution
    if has_jacobian(solution) and solution.at is not None:
        return solution
    asked = _CentralJacobian(not has_jacobian(solution))
    start_space = with_start(space, solution.x)
    (found,) = runner.run([SearchRequest("derivatives", asked, start_space)])
    if not found.ending.success:
        return solution
    solution = replace(solution, cost=found.cost, at=found.at)
    if has_jacobian(solution):
        return solution
    return replace(
        solution,
        jacobian=found.jacobian,
        block_jacobian=found.block_jacobian,
        difference_steps=found.difference_steps,
        frozen=found.frozen,
    )


def sharpen(runner: Runner, space: SearchSpace, solution: Solution) -> tuple[Solution, FloatArray]:
    """Measure derivatives along the directions in which the residuals hardly change.

    Returns
    -------
    solution
        The solution with a Jacobian whose products with these directions are the measured ones.
    steps : (unknowns,)
        The relative step; 0 if nothing was measured, and for unknowns in directions that could not
        be measured.
    """
    system, steps = scaled_jacobian(space, solution, weak=SUSPECT), np.zeros(space.size)
    for _ in range(MOST_DIRECTION_ROUNDS):
        if system is None or not system.combinations:
            break
        found = _measured(runner, space, solution, system)
        if found is None:
            break
        solution, steps = found
        least = min(direction.ratio for direction in system.combinations)
        system = scaled_jacobian(space, solution, steps, SUSPECT)
        if system is None or not any(
            not c.undetermined and c.ratio < REPEATED_RATIO * least for c in system.combinations
        ):
            break
    return solution, steps


def _measured(
    runner: Runner, space: SearchSpace, solution: Solution, system: ScaledJacobian
) -> tuple[Solution, FloatArray] | None:
    """Return the solution with measured derivatives, and the steps; None if this failed.

    If bounds are too close along a direction, or simulations fail, its derivatives are kept. The
    other directions are still measured.
    """
    matrix = jacobian_blocks(space, solution)
    assert matrix is not None
    found = vectors(space, system.unbounded_layout, system.combinations)
    basis = np.asarray(np.linalg.qr(found.T)[0])
    directions = basis.T / system.scale
    lengths, relative = _lengths(space, solution.x, directions)
    own_step = (
        0.0
        if solution.difference_steps is None
        else float(
            np.max(
                np.abs(solution.difference_steps) / relative_sizes(space, solution.x), initial=0.0
            )
        )
    )
    chosen = np.flatnonzero(relative > own_step)
    if not len(chosen):
        return None
    asked = _DirectionalDifferences((directions * lengths[:, None])[chosen])
    start_space = with_start(space, solution.x)
    (measured,) = runner.run([SearchRequest("directions", asked, start_space)])
    if measured.jacobian is None or solution.at is None:
        return None
    known = np.isfinite(measured.jacobian).all(axis=0)
    chosen = chosen[known]
    products = measured.jacobian[:, known] / lengths[chosen]
    others = np.delete(np.arange(len(directions)), chosen)
    unsure = (np.abs(basis[:, others]) > ROUNDING_OF_DIRECTION).any(axis=1)
    steps = np.where(unsure, 0.0, float(np.min(relative[chosen])))
    corrected = _corrected(matrix, system, basis[:, chosen], products)
    return with_jacobian(solution, corrected), steps


def _lengths(
    space: SearchSpace, x: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the step along each direction, and its relative change.

    Bounds of unknowns that change only by rounding errors are ignored.
    """
    noise = relative_noise(space.problem.model.solver)
    step = min(max(noise**0.2, LEAST_STEP), LARGEST_STEP)
    parts = np.abs(directions) / relative_sizes(space, x)
    largest = np.max(parts, axis=1)
    distance = np.minimum(space.upper - x, x - space.lower)
    far = np.full(directions.shape, np.inf)
    np.divide(
        distance,
        np.abs(directions),
        out=far,
        where=parts > ROUNDING_OF_DIRECTION * largest[:, None],
    )
    most = np.min(far, axis=1)
    lengths = np.minimum(step / largest, most)
    return lengths, lengths * largest


def _corrected(
    matrix: BlockMatrix, system: ScaledJacobian, directions: FloatArray, products: FloatArray
) -> BlockMatrix:
    """Return the Jacobian with the measured products with directions, and the least change.

    Derivatives by unknowns that do not act on an experiment stay 0.
    """
    blocks = []
    for block, acting, rows in zip(matrix.blocks, matrix.columns, matrix.rows, strict=True):
        part = directions[acting]
        scaled = block / system.scale[acting]
        change = (products[rows] - scaled @ part) @ np.linalg.pinv(part, rcond=1e-8)
        blocks.append((scaled + change) * system.scale[acting])
    return replace(matrix, blocks=tuple(blocks))


@dataclass(frozen=True)
class _CentralJacobian(Method):
    """Evaluates the start and, if requested, a central Jacobian there."""

    name: ClassVar[str] = "derivatives"
    needs_residuals: ClassVar[bool] = False

    derivatives: bool

    @override
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
            jacobian=found.dense_if_small,
            block_jacobian=found.blocks_if_large,
            difference_steps=found.steps,
            frozen=found.frozen,
            at=at,
        )


@dataclass(frozen=True)
class _DirectionalDifferences(Method):
    """Computes fourth-order directional derivatives of the residuals at the start.

    They are NaN if simulations fail with all step lengths.

    Attributes
    ----------
    steps : (directions, unknowns)
        Steps, which are taken forwards and backwards, with full and half length.
    """

    name: ClassVar[str] = "directions"
    needs_residuals: ClassVar[bool] = True

    steps: FloatArray = field(repr=False)

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        x = space.start
        products: dict[int, FloatArray] = {}
        missing = np.arange(len(self.steps))
        for length in DIRECTIONAL_STEP_LENGTHS:
            steps = length * self.steps[missing]
            parts = [x + share * steps for share in (1.0, -1.0, 0.5, -0.5)]
            points = np.clip(np.vstack(parts), space.lower, space.upper)
            found = yield Points(points, "direction")
            for k, j in enumerate(missing.tolist()):
                four = [found[k + q * len(missing)] for q in range(4)]
                if all(evaluation.ok for evaluation in four):
                    products[j] = self._derivative(four) / length
            missing = np.array([j for j in missing.tolist() if j not in products], np.intp)
            if not len(missing):
                break
        if not products:
            return Solution(x, np.nan, Ending.DERIVATIVES_FAILED)
        unknown = np.full(len(next(iter(products.values()))), np.nan)
        columns = [products.get(j, unknown) for j in range(len(self.steps))]
        return Solution(x, np.nan, Ending.CONVERGED, jacobian=np.column_stack(columns))

    def _derivative(self, four: Sequence[Evaluation]) -> FloatArray:
        """Return Richardson's extrapolation of two central differences."""
        plus, minus, half_plus, half_minus = (evaluation.residuals for evaluation in four)
        whole, half = (plus - minus) / 2.0, half_plus - half_minus
        return np.asarray((4.0 * half - whole) / 3.0)
