"""The early end of a simulation: a running sum of squares that is above a bound already."""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined

SUM, BOUND = range(2)
"""Places in `KernelWorkspace.squares`: the sum so far, and the bound."""
ROUNDING = 1.0 + 1e-9
"""By how much a sum must be above its bound, which is compared with a sum in another order."""


@inlined
def begin_squares(bounds, p, work):  # type: ignore[no-untyped-def]
    """Begin the sum of squares of a simulation, with the bound of its point."""
    work.squares[SUM] = 0.0
    work.squares[BOUND] = bounds[p] * ROUNDING


@inlined
def is_above_bound(grid, i, outputs, work):  # type: ignore[no-untyped-def]
    """Add the squares of the residuals at grid time i; return whether the sum is above its bound.

    `outputs` are those that were recorded at that time. Squares are not negative, so the sum of the
    whole record is above the bound, too.
    """
    if not work.squares[BOUND] < float("inf"):
        return False
    first = grid.row_ends[i - 1] if i > 0 else 0
    for k in range(first, grid.row_ends[i]):
        place = grid.by_time[k]
        simulated = outputs[grid.gather[place] - i * len(outputs)]
        residual = (grid.measured[place] - simulated) / grid.sigmas[place]
        work.squares[SUM] += residual * residual
    return work.squares[SUM] > work.squares[BOUND]
