"""Residuals and constraints of one experiment.

A method that needs only a sum over residuals receives one number for each output instead of its
residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from workers.grid import SignalGrid
from workers.messages import Curve, Experiment, FloatArray, SignalBound, Want
from workers.residuals.comparison import Comparison, ComparisonResult, SimulatedOutputs, positions
from workers.residuals.functions import FunctionComparison
from workers.residuals.nearest_segment import segment_distances, tolerance_constraints
from workers.residuals.observed import ObservedOutputs


class MeasuredTimes(Comparison):
    """One residual for each measured value, in units of its standard deviation.

    No interpolation is needed, because the grid contains every measured time.
    """

    def __init__(self, grid: SignalGrid) -> None:
        self._grid = grid

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        grid, outputs = self._grid, simulated.outputs
        # take keeps each point's row contiguous: sums over strided rows round differently
        simulated_values = np.take(outputs.reshape(len(outputs), -1), grid.gather, axis=1)
        with np.errstate(over="ignore"):  # overflow is reported as not finite
            return ComparisonResult((grid.measured - simulated_values) / grid.sigmas)

    def jacobian(self, sensitivities: FloatArray) -> FloatArray:
        """Return the (parameters, residuals) derivatives, from the derivatives of the outputs."""
        grid = self._grid
        return (
            -np.take(sensitivities.reshape(len(sensitivities), -1), grid.gather, axis=1)
            / grid.sigmas
        )


class SignalBounds(Comparison):
    """For each side of each bound, the largest violation over its times; at most 0 if satisfied.

    lower: max over t of (lower(t) - y(t)) / scale; upper: max of (y(t) - upper(t)) / scale;
    equality: the value of (y(t) - lower(t)) / scale with the largest magnitude.
    """

    def __init__(self, bounds: tuple[SignalBound, ...]) -> None:
        self._bounds = bounds

    @np.errstate(over="ignore", invalid="ignore")  # overflow is reported as not finite
    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        columns = [column for bound in self._bounds for column in _sides(bound, simulated)]
        table = np.array(columns, np.float64).reshape(-1, len(simulated.outputs))
        return ComparisonResult(np.ascontiguousarray(table.T))


def _sides(bound: SignalBound, simulated: SimulatedOutputs) -> list[FloatArray]:
    """Return the largest violation of each side of a bound, (points,) each."""
    rows = positions(bound.times, simulated.times)
    signal = simulated.of(bound.variable)[:, rows]
    if bound.equality:
        gaps = (signal - bound.lower) / bound.scale
        farthest = np.argmax(np.abs(gaps), axis=1)
        return [gaps[np.arange(len(gaps)), farthest]]
    found = []
    for limit, sign in ((bound.lower, -1.0), (bound.upper, 1.0)):
        held = np.isfinite(limit)
        if held.any():
            found.append(np.max(sign * (signal[:, held] - limit[held]), axis=1) / bound.scale)
    return found


class CurveDistances(Comparison):
    """For each segment between two measured points, its distance to the nearest simulated point."""

    def __init__(self, curve: Curve) -> None:
        self._curve = curve

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        points = _points(self._curve, simulated)
        found = [segment_distances(each, self._curve.points) for each in points]
        return ComparisonResult(np.array(found, np.float64).reshape(len(points), -1))


class CurveTolerances(Comparison):
    """For each tolerance, the distance of the farthest simulated point from the measured curve."""

    def __init__(self, curve: Curve) -> None:
        self._curve = curve

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        tolerances = np.array(self._curve.tolerances)
        points = _points(self._curve, simulated)
        found = [tolerance_constraints(each, self._curve.points, tolerances) for each in points]
        return ComparisonResult(np.array(found, np.float64).reshape(len(points), -1))


def _points(curve: Curve, simulated: SimulatedOutputs) -> FloatArray:
    """Return the simulated curves at their sampling times, (points, m, d)."""
    rows = positions(curve.times, simulated.times)
    columns = [simulated.names.index(name) for name in curve.variables]
    return np.ascontiguousarray(simulated.outputs[:, rows][:, :, columns])


COMPARISON_STEP = 1e-6
"""Relative step of the outputs for a comparison that is nonlinear in them. Its only noise is
rounding, because no simulation is involved."""


def comparison_jacobian(
    comparison: Comparison, simulated: SimulatedOutputs, sensitivities: FloatArray
) -> FloatArray:
    """Return the (k, parameters) derivatives of the values of a comparison.

    Parameters
    ----------
    simulated
        A single simulation.
    sensitivities : (parameters, n, names)
        Derivatives of its outputs.
    """
    if isinstance(comparison, MeasuredTimes):
        return np.ascontiguousarray(comparison.jacobian(sensitivities).T)
    count = len(sensitivities)
    steps = _steps(simulated, sensitivities)
    values = np.repeat(simulated.values[:, :count], count, axis=0)
    found = []
    for sign in (1.0, -1.0):
        outputs = simulated.outputs + sign * steps[:, None, None] * sensitivities
        perturbed = replace(simulated, outputs=outputs, values=values + sign * np.diag(steps))
        found.append(comparison.compare(perturbed).values)
    return np.ascontiguousarray(((found[0] - found[1]) / (2.0 * steps[:, None])).T)


def _steps(simulated: SimulatedOutputs, sensitivities: FloatArray) -> FloatArray:
    """Return a step for each parameter that changes the parameter and the outputs only slightly."""
    largest = np.abs(sensitivities).max(axis=(1, 2), initial=0.0)
    size = np.abs(simulated.outputs).max(initial=0.0) or 1.0
    own = np.abs(simulated.values[0, : len(sensitivities)])
    own[own == 0.0] = 1.0
    with np.errstate(divide="ignore"):
        steps: FloatArray = COMPARISON_STEP * np.fmin(own, size / largest)
    return steps


class BatchComparison(NamedTuple):
    """(points, k) residuals, (points, m) constraints, and failure messages by point."""

    residuals: FloatArray
    constraints: FloatArray
    failures: dict[int, str]


class ExperimentComparison:
    """The residuals and constraints of one experiment.

    Parameters
    ----------
    experiment, grid
        The experiment, and the grid on which it is simulated.
    parameters
        Names of the parameters whose values are in the tasks.

    Raises
    ------
    ModelError
        If a user's function cannot be loaded.
    """

    def __init__(
        self, experiment: Experiment, grid: SignalGrid, parameters: tuple[str, ...]
    ) -> None:
        self._residuals = _residuals(experiment, grid, parameters)
        self.is_plain = all(isinstance(each, MeasuredTimes) for each in self._residuals)
        """Whether every residual is (measured - simulated) / sigma of a value of the grid."""
        self._constraints = _constraints(experiment, parameters)

    def compare(self, simulated: SimulatedOutputs) -> BatchComparison:
        """Compare a batch of simulations."""
        failures: dict[int, str] = {}
        residuals = _joined(self._residuals, simulated, failures)
        return BatchComparison(residuals, _joined(self._constraints, simulated, failures), failures)

    def jacobian(self, simulated: SimulatedOutputs, sensitivities: FloatArray) -> FloatArray:
        """Return the (residuals + constraints, parameters) derivatives of one simulation.

        `sensitivities` are the derivatives of its outputs, (parameters, n, names).
        """
        kinds = (*self._residuals, *self._constraints)
        parts = [comparison_jacobian(each, simulated, sensitivities) for each in kinds]
        return np.concatenate([np.zeros((0, len(sensitivities))), *parts])


def _residuals(
    experiment: Experiment, grid: SignalGrid, parameters: tuple[str, ...]
) -> list[Comparison]:
    if experiment.cost_function is not None:
        return [FunctionComparison(experiment.cost_function, experiment, parameters, single=False)]
    found: list[Comparison] = []
    if experiment.outputs or experiment.curve is None:
        plain = all(output.is_plain for output in experiment.outputs)
        found.append(MeasuredTimes(grid) if plain else ObservedOutputs(grid, experiment))
    if experiment.curve is not None:
        found.append(CurveDistances(experiment.curve))
    return found


def _constraints(experiment: Experiment, parameters: tuple[str, ...]) -> list[Comparison]:
    found: list[Comparison] = []
    if experiment.curve is not None and experiment.curve.names:
        found.append(CurveTolerances(experiment.curve))
    if experiment.bounds:
        found.append(SignalBounds(experiment.bounds))
    functions = experiment.constraint_functions
    own = [FunctionComparison(f, experiment, parameters, single=True) for f in functions]
    return [*found, *own]


def _joined(
    comparisons: list[Comparison], simulated: SimulatedOutputs, failures: dict[int, str]
) -> FloatArray:
    if not comparisons:
        return np.zeros((len(simulated.outputs), 0))
    parts = []
    for comparison in comparisons:
        compared = comparison.compare(simulated)
        failures |= compared.failures
        parts.append(compared.values)
    if len(parts) == 1:
        return parts[0]
    return np.concatenate([np.zeros((len(simulated.outputs), 0)), *parts], axis=1)


def reduce_residuals(residuals: FloatArray, counts: Sequence[int], want: Want) -> FloatArray:
    """Reduce the residuals of one simulation, output by output.

    Parameters
    ----------
    residuals : (sum of counts,)
        Residuals of the outputs, concatenated.
    counts
        Number of residuals of each output, as in `Experiment.counts`.
    want
        "squares" for the root of the sum of squares, "absolutes" for the sum of absolute values.

    Returns
    -------
    (k,)
        One number for each output with residuals, as in `Experiment.counts_in`.
    """
    squares = want == "squares"
    sizes = residuals * residuals if squares else np.abs(residuals)  # contiguous, for equal bits
    filled = [count for count in counts if count]
    ends = np.cumsum(filled, dtype=np.intp).tolist()
    parts = zip(filled, ends, strict=True)
    sums = np.array([np.add.reduce(sizes[end - count : end]) for count, end in parts], np.float64)
    return np.sqrt(sums) if squares else sums
