"""Broyden's update: a Jacobian for the next point from the last one and what its step has shown.

    J+ = J + (dr - J p) (D^2 p)' / (p' D^2 p)

is the least change, in the scaled norm, with which J+ p = dr, the change of the residuals that was
seen (C. G. Broyden, Math. Comp. 19 (1965) 577-593, doi:10.1090/S0025-5718-1965-0198670-6). It costs
no simulation, where differences cost one for each unknown.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.derivatives.differences import ResidualJacobian
from cluster_est.methods.least_squares.iteration import IterationState

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
    parts = []
    for block, columns, rows in zip(blocks.blocks, blocks.columns, blocks.rows, strict=True):
        length = float(direction[columns] @ step[columns])
        change = np.outer(missed[rows], direction[columns]) / length if length > 0.0 else 0.0
        parts.append(block + change)
    return replace(jacobian, blocks=BlockMatrix(tuple(parts), blocks.columns, blocks.size))
