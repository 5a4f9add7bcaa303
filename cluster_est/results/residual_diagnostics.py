"""The residuals of a fit put to their tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.observation import lack_normal_law
from cluster_est.results.output_errors import Simulation, output_residuals
from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.records import StackedRecords, make_records
from cluster_est.statistics.residual_findings import ResidualDiagnostics
from cluster_est.statistics.residual_tests import MOST_TRANSFORMED_ENTRIES, ResidualTests
from cluster_est.uncertainty.covariance.normal_equations import (
    active_bounds,
    has_jacobian,
    jacobian_blocks,
)
from workers.messages import FloatArray

EXACT_FIT_RESIDUAL = 1e-5
"""Residuals over the spread of the signal up to which they are numerical errors: no sensor is so
good, and what is simulated data without noise has no sigma."""


def diagnose_residuals(
    space: SearchSpace, solution: Solution, simulations: Sequence[Simulation]
) -> ResidualDiagnostics | None:
    """Test the training residuals of a fit for what is left in them, and their size.

    Structure is looked for by `smoothness`, behind the projection of the fit where its Jacobian is
    known, for each output and for all together (Bonferroni). The size of a mean square is judged by
    a chi-squared distribution with the degrees of freedom that the parameters left, divided by what
    autocorrelation takes away (`Autocorrelation.squares`).

    Parameters
    ----------
    space, solution
        Of the training experiments. Its Jacobian is used if it has one.
    simulations
        Of every experiment of the problem at the estimates, with trajectories.

    Returns
    -------
    ResidualDiagnostics or None
        None where residuals have no such meaning: another cost than the sum of squares, curves,
        cost functions, constraints, a failed simulation, a search that was interrupted.
    """
    problem, ending = space.problem, solution.ending
    asked = ending.success or ending in (Ending.MAX_ITERATIONS, Ending.STALLED)
    if not (asked and problem.plain and isinstance(problem.cost, SumSquared)):
        return None
    residuals = training_residuals(space, simulations)
    if residuals is None or lack_normal_law(space.problem, space.experiments):
        return None
    records = make_records([problem.experiments[e] for e in space.experiments])
    declared = _declared(space, records)
    if noise_names(problem):  # innovations are white over their own spread, which is no sigma
        residuals, declared = _innovations(space, solution), (False,) * len(declared)
    if not np.isfinite(residuals).all():
        return None
    exact = _exact(space, residuals, records)
    basis = _basis(space, solution, len(residuals))
    tests = ResidualTests(residuals, records, basis, declared, exact)
    return ResidualDiagnostics(*tests.run(), converged=ending.success)


def training_residuals(space: SearchSpace, simulations: Sequence[Simulation]) -> FloatArray | None:
    """Return the residuals of all outputs, stacked, without those of priors; None if one failed."""
    outcomes = {s.experiment: s.outcome for s in simulations}
    parts = [
        output_residuals(output, outcomes[e])
        for e in space.experiments
        for output in space.problem.experiments[e].outputs
    ]
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known and len(known) == len(parts) else None


def _innovations(space: SearchSpace, solution: Solution) -> FloatArray:
    """The residuals of a fit with process noise, without those of priors; NaN if it has none."""
    at = solution.at
    if at is None or not at.ok:
        return np.full(1, np.nan)
    return np.asarray(at.residuals[~space.priors.among(space.rows)])


def _declared(space: SearchSpace, records: StackedRecords) -> tuple[bool, ...]:
    """Whether each output has a sigma: not where all are 1, nor where it is as large as the signal.

    The latter is what a normalised output has.
    """
    outputs = [o for e in space.experiments for o in space.problem.experiments[e].outputs]
    if not any(output.has_sigma for output in outputs):
        return (False,) * len(records.outputs)
    found = dict.fromkeys(records.outputs, False)
    for output in outputs:
        if len(output.values) and output.sigma < np.std(output.values):
            found[output.variable] = True
    return tuple(found.values())


def _exact(space: SearchSpace, residuals: FloatArray, records: StackedRecords) -> tuple[bool, ...]:
    """Return whether each output is followed as closely as only numbers without noise can be."""
    outputs = [o for e in space.experiments for o in space.problem.experiments[e].outputs]
    errors, spreads = np.zeros(len(records.outputs)), np.zeros(len(records.outputs))
    for item, output in zip(records.items, outputs, strict=True):
        if len(output.values):
            errors[item.output] += np.add.reduce((residuals[item.rows] * output.sigmas) ** 2)
            spreads[item.output] += len(output.values) * np.var(output.values)
    return tuple((errors <= EXACT_FIT_RESIDUAL**2 * spreads).tolist())


def _basis(space: SearchSpace, solution: Solution, count: int) -> FloatArray:
    """Directions that the free unknowns have taken out of the residuals, orthonormal (n, rank)."""
    matrix = free_jacobian(space, solution, count, MOST_TRANSFORMED_ENTRIES)
    return np.zeros((count, 0)) if matrix is None else OrthogonalProjection(matrix).basis


def free_jacobian(
    space: SearchSpace, solution: Solution, count: int, most: int
) -> FloatArray | None:
    """Return the derivatives of the residuals by the unknowns that are at no bound.

    Parameters
    ----------
    space, solution
        Of the training experiments.
    count
        Of the residuals, without those of priors.
    most
        Entries that it may have.

    Returns
    -------
    (count, free unknowns) or None
        None where they are not known, or too many.
    """
    if not has_jacobian(solution) or count * space.size > most:
        return None
    blocks, priors = jacobian_blocks(space, solution), space.priors.among(space.rows)
    if blocks is None or blocks.row_count != count + int(priors.sum()):
        return None
    free = [i for i, bound in enumerate(active_bounds(space, solution.x, blocks)) if not bound]
    matrix = blocks.dense()[:, free]
    matrix = matrix[~priors] if priors.any() else matrix
    return matrix if np.isfinite(matrix).all() else None
