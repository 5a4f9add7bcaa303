"""The methods by which candidates are refitted: a little, a little more, and to convergence."""

from __future__ import annotations

from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares

BRIEFLY = 1e-4
"""Relative fall of the sum of squares that ends a refit at most: of two decimals one is enough to
see who is ahead."""

FIRST = LeastSquares(trials=1, max_iterations=1, ftol=BRIEFLY, xtol=1e-5, differences="forward")
SHORT = LeastSquares(trials=1, max_iterations=2, ftol=BRIEFLY, xtol=1e-5, differences="forward")


def full_refit(workbench: LoopWorkbench) -> LeastSquares:
    """Return the refit to convergence.

    The criterion of n residuals of one output falls by n times the relative fall of their squares,
    so it ends where that is a part of the smallest difference that tells two candidates apart. An
    output with a small part of all squares may move the criterion by more.
    """
    settled = workbench.thresholds.refinement.settled / max(workbench.size, 1)
    ftol = min(BRIEFLY, settled)
    return LeastSquares(trials=1, max_iterations=15, ftol=ftol, xtol=1e-5, differences="forward")
