"""Outputs that are known up to scale and offset, or not below a detection limit.

Where an output is known up to scale and offset, the residuals are those after the best ones:

    e = (measured - a simulated - b) / sigma,   (a, b) = argmin sum e^2,

in closed form for each experiment, so that no search has to find them (variable projection: G. H.
Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, doi:10.1137/0710036).

A value at or below a detection limit says no more than that. Its residual is

    e = -sqrt(-2 log Phi((limit - simulated) / sigma)),

whose square is -2 log of the probability of measuring no more than the limit (J. Tobin,
Econometrica 26 (1958) 24-36, doi:10.2307/1907382): 0 where the simulation lies far below it.
"""

from __future__ import annotations

import numpy as np

from workers.grid import SignalGrid
from workers.messages import Experiment, FloatArray, Output
from workers.residuals.base import Comparison, ComparisonResult, SimulatedOutputs


class ObservedOutputs(Comparison):
    """One residual for each measured value, of outputs of which at least one is not plain."""

    def __init__(self, grid: SignalGrid, experiment: Experiment) -> None:
        self._grid, self._outputs = grid, experiment.outputs

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        outputs = simulated.outputs
        values = np.take(outputs.reshape(len(outputs), -1), self._grid.gather, axis=1)
        found = np.empty_like(values)
        for own, row in zip(values, found, strict=True):
            first = 0
            for output in self._outputs:
                rows = slice(first, first + len(output.times))
                row[rows] = observed_residuals(output, own[rows])
                first = rows.stop
        return ComparisonResult(found)


def observed_residuals(output: Output, simulated: FloatArray) -> FloatArray:
    """Return the residuals of one output, (n,), from what was simulated at its measured times."""
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is said to be not finite
        scale, offset = scale_and_offset(output, simulated)
        residuals = (output.values - scale * simulated - offset) / output.sigmas
    if output.detection_limit is None:
        return np.asarray(residuals)
    return np.asarray(np.where(output.is_hidden, _censored(output, simulated), residuals))


def scale_and_offset(output: Output, simulated: FloatArray) -> tuple[float, float]:
    """Return the best scale and offset of what was simulated; 1 and 0 where they are not free.

    Where the simulation does not move, so that they could not be told apart, the scale is 0 and the
    offset what was measured; without an offset, where it is 0 throughout, the scale is 0.
    """
    if not (output.free_scale or output.free_offset) or not len(simulated):
        return 1.0, 0.0
    weights = 1.0 / output.sigmas**2
    total = np.add.reduce(weights)
    mean = float(np.add.reduce(weights * simulated) / total)
    measured = float(np.add.reduce(weights * output.values) / total)
    if not output.free_scale:
        return 1.0, measured - mean
    centre, middle = (mean, measured) if output.free_offset else (0.0, 0.0)
    moved = simulated - centre
    square = float(np.add.reduce(weights * moved**2))
    if not np.isfinite(square):
        return np.nan, np.nan
    if not square > 1e-24 * float(np.add.reduce(weights * simulated**2)):
        return 0.0, middle
    scale = float(np.add.reduce(weights * moved * (output.values - middle))) / square
    return scale, middle - scale * centre


def _censored(output: Output, simulated: FloatArray) -> FloatArray:
    """The residuals that the samples have if all of them are at or below the detection limit."""
    from scipy.special import log_ndtr  # slow to load, and few need it

    assert output.detection_limit is not None
    logs = log_ndtr((output.detection_limit - simulated) / output.sigmas)
    return np.asarray(-np.sqrt(-2.0 * np.minimum(logs, 0.0)))
