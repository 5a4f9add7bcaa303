"""Tests of the residuals of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.sigmas import guessed_outputs
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
"""Largest residual, over the standard deviation of the signal, that is only numerical error. No
sensor is that accurate; such data are simulated without noise."""


def diagnose_residuals(
    space: SearchSpace, solution: Solution, simulations: Sequence[Simulation]
) -> ResidualDiagnostics | None:
    """Test the training residuals of a fit for structure, and their size.

    `smoothness` tests for structure, for each output and for all outputs together (Bonferroni). If
    the Jacobian is known, the test includes the effect of the fit. The size of a mean square is
    compared with a chi-squared distribution. Its degrees of freedom are the remaining ones, divided
    by the factor for autocorrelation (`Autocorrelation.squares`).

    Parameters
    ----------
    space, solution
        Search space and solution of the training experiments; the Jacobian may be missing.
    simulations
        Simulations of all experiments at the estimates, with trajectories.

    Returns
    -------
    ResidualDiagnostics or None
        None if the tests do not apply: another cost than the sum of squares, curves, cost
        functions, constraints, a failed simulation, or an interrupted search.
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
    if noise_names(problem):  # innovations are scaled with their own spread, not with sigma
        residuals, declared = _innovations(space, solution), (False,) * len(declared)
    if not np.isfinite(residuals).all():
        return None
    exact = _exact(space, residuals, records)
    basis = _basis(space, solution, len(residuals))
    tests = ResidualTests(residuals, records, basis, declared, exact)
    return ResidualDiagnostics(*tests.run(), converged=ending.success)


def training_residuals(space: SearchSpace, simulations: Sequence[Simulation]) -> FloatArray | None:
    """Return the stacked residuals of all outputs, without priors; None if a simulation failed."""
    outcomes = {s.experiment: s.outcome for s in simulations}
    parts = [
        output_residuals(output, outcomes[e])
        for e in space.experiments
        for output in space.problem.experiments[e].outputs
    ]
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known and len(known) == len(parts) else None


def _innovations(space: SearchSpace, solution: Solution) -> FloatArray:
    """Return the residuals of a fit with process noise, without priors; NaN if there are none."""
    at = solution.at
    if at is None or not at.ok:
        return np.full(1, np.nan)
    return np.asarray(at.residuals[~space.priors.among(space.rows)])


def _declared(space: SearchSpace, records: StackedRecords) -> tuple[bool, ...]:
    """Return whether each output has a declared sigma.

    Sigmas do not count if all are 1, and those of an output do not if one of them is a guess. A
    sigma as large as the signal, as for a normalised output, does not count either.
    """
    outputs = [o for e in space.experiments for o in space.problem.experiments[e].outputs]
    if not any(output.has_sigma for output in outputs):
        return (False,) * len(records.outputs)
    found = dict.fromkeys(records.outputs, False)
    for output in outputs:
        if len(output.values) and output.sigma < np.std(output.values):
            found[output.variable] = True
    guessed = guessed_outputs(outputs)
    return tuple(found[name] and name not in guessed for name in found)


def _exact(space: SearchSpace, residuals: FloatArray, records: StackedRecords) -> tuple[bool, ...]:
    """Return whether the residuals of each output are only numerical errors."""
    outputs = [o for e in space.experiments for o in space.problem.experiments[e].outputs]
    errors, spreads = np.zeros(len(records.outputs)), np.zeros(len(records.outputs))
    for item, output in zip(records.items, outputs, strict=True):
        if len(output.values):
            errors[item.output] += np.add.reduce((residuals[item.rows] * output.sigmas) ** 2)
            spreads[item.output] += len(output.values) * np.var(output.values)
    return tuple((errors <= EXACT_FIT_RESIDUAL**2 * spreads).tolist())


def _basis(space: SearchSpace, solution: Solution, count: int) -> FloatArray:
    """Return orthonormal directions that the fit has removed from the residuals: (n, rank)."""
    matrix = free_jacobian(space, solution, count, MOST_TRANSFORMED_ENTRIES)
    return np.zeros((count, 0)) if matrix is None else OrthogonalProjection(matrix).basis


def free_jacobian(
    space: SearchSpace, solution: Solution, count: int, most: int
) -> FloatArray | None:
    """Return the derivatives of the residuals by the unknowns that are not at a bound.

    Parameters
    ----------
    space, solution
        Search space and solution of the training experiments.
    count
        Number of residuals, without those of priors.
    most
        Largest number of entries.

    Returns
    -------
    (count, free unknowns) or None
        None if the derivatives are not known, or if there are too many entries.
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
