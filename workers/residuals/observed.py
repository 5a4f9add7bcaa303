"""Outputs with free scale and offset, with a detection limit, or with ordinal values.

With free scale and offset, the residuals are

    e = (measured - a simulated - b) / sigma,   (a, b) = argmin sum e^2,

in closed form for each experiment, so a search does not need to estimate a and b (variable
projection: G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, doi:10.1137/0710036).
For a held-out part of a record, a and b are those of its training part. The same holds for the
bounds of categories (`ordinal`).

A value at or below a detection limit is censored. Its residual is

    e = -sqrt(-2 log Phi((limit - simulated) / sigma)),

whose square is -2 log of the probability of measuring at most the limit (J. Tobin, Econometrica 26
(1958) 24-36, doi:10.2307/1907382). It is 0 if the simulation is far below the limit.
"""

from __future__ import annotations

import numpy as np

from workers.grid import SignalGrid
from workers.messages import Experiment, FloatArray, Output
from workers.residuals.comparison import Comparison, ComparisonResult, SimulatedOutputs, positions
from workers.residuals.ordinal import CategoryBounds, category_bounds, ordinal_residuals


class ObservedOutputs(Comparison):
    """One residual for each measured value, of outputs of which at least one is not plain."""

    def __init__(self, grid: SignalGrid, experiment: Experiment) -> None:
        self._grid, self._outputs = grid, experiment.outputs
        self._learnt = [positions(learnt_from(each).times, grid.times) for each in self._outputs]

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        outputs = simulated.outputs
        values = np.take(outputs.reshape(len(outputs), -1), self._grid.gather, axis=1)
        found, first = np.empty_like(values), 0
        for output, learnt in zip(self._outputs, self._learnt, strict=True):
            rows = slice(first, first + len(output.times))
            first = rows.stop
            own = values[:, rows]
            training = own if output.reference is None else simulated.of(output.variable)[:, learnt]
            for point, row in enumerate(found):
                row[rows] = observed_residuals(output, own[point], training[point])
        return ComparisonResult(found)


def learnt_from(output: Output) -> Output:
    """Return the output from which scale, offset and category bounds are estimated."""
    learns = output.learns and output.reference is not None
    return output.reference if learns and output.reference is not None else output


def observed_residuals(
    output: Output, simulated: FloatArray, training: FloatArray | None = None
) -> FloatArray:
    """Return the residuals of one output, (n,).

    Parameters
    ----------
    simulated : (n,)
        Simulated values at its measured times.
    training : (m,)
        Simulated values at the times of `learnt_from`; None for the same values.
    """
    if output.ordinal:
        if not len(simulated):
            return np.zeros(0)
        bounds = bounds_of_categories(output, simulated, training)
        return ordinal_residuals(bounds, output.values, simulated, output.sigma)
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported as not finite
        scale, offset = scale_and_offset(output, simulated, training)
        residuals = (output.values - scale * simulated - offset) / output.sigmas
    if output.detection_limit is None:
        return np.asarray(residuals)
    return np.asarray(np.where(output.is_hidden, _censored(output, simulated), residuals))


def bounds_of_categories(
    output: Output, simulated: FloatArray, training: FloatArray | None = None
) -> CategoryBounds:
    """Return the best category bounds of an ordinal output; see `observed_residuals`."""
    values = simulated if training is None else training
    return category_bounds(learnt_from(output).values, np.ascontiguousarray(values))


def scale_and_offset(
    output: Output, simulated: FloatArray, training: FloatArray | None = None
) -> tuple[float, float]:
    """Return the best scale and offset of the simulated values; 1 and 0 if they are not free.

    If the simulated values are constant, scale and offset cannot be distinguished. Then the scale
    is 0, and the offset is the mean of the measured values. Without a free offset, the scale is 0
    if all simulated values are 0. The parameters are those of `observed_residuals`.
    """
    if not (output.free_scale or output.free_offset) or not len(simulated):
        return 1.0, 0.0
    source, values = learnt_from(output), simulated if training is None else training
    return best_scale_and_offset(
        source.values,
        values,
        source.sigmas,
        free_scale=output.free_scale,
        free_offset=output.free_offset,
    )


def best_scale_and_offset(
    measured: FloatArray,
    simulated: FloatArray,
    sigmas: FloatArray,
    *,
    free_scale: bool,
    free_offset: bool,
) -> tuple[float, float]:
    """Return the scale and offset of simulated values (n,) that fit the measured values best.

    1 and 0 if they are not free, or if there are no values; see `scale_and_offset`.
    """
    if not len(measured):
        return 1.0, 0.0
    simulated = np.ascontiguousarray(simulated)  # sums over strided rows round differently
    weights = 1.0 / sigmas**2
    total = np.add.reduce(weights)
    mean = float(np.add.reduce(weights * simulated) / total)
    middle = float(np.add.reduce(weights * measured) / total)
    if not free_scale:
        return 1.0, middle - mean
    centre, middle = (mean, middle) if free_offset else (0.0, 0.0)
    moved = simulated - centre
    square = float(np.add.reduce(weights * moved**2))
    if not np.isfinite(square):
        return np.nan, np.nan
    if not square > 1e-24 * float(np.add.reduce(weights * simulated**2)):
        return 0.0, middle
    scale = float(np.add.reduce(weights * moved * (measured - middle))) / square
    return scale, middle - scale * centre


def _censored(output: Output, simulated: FloatArray) -> FloatArray:
    """Return the residuals of all samples as if they were at or below the detection limit."""
    from scipy.special import log_ndtr  # slow to load, and rarely needed

    assert output.detection_limit is not None
    logs = log_ndtr((output.detection_limit - simulated) / output.sigmas)
    return np.asarray(-np.sqrt(-2.0 * np.minimum(logs, 0.0)))
