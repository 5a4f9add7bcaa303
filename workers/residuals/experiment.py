"""Residuals and constraints of one experiment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from workers.grid import SignalGrid
from workers.messages import Experiment, FloatArray
from workers.residuals.base import Comparison, SimulatedOutputs
from workers.residuals.bounds import SignalBounds
from workers.residuals.curve import CurveDistances, CurveTolerances
from workers.residuals.functions import FunctionComparison
from workers.residuals.jacobian import comparison_jacobian
from workers.residuals.measured_times import MeasuredTimes
from workers.residuals.observed import ObservedOutputs


class BatchComparison(NamedTuple):
    """(points, k) residuals, (points, m) constraints, and why a point has none."""

    residuals: FloatArray
    constraints: FloatArray
    failures: dict[int, str]


class ExperimentComparison:
    """The residuals and constraints of one experiment.

    Parameters
    ----------
    experiment, grid
        What is compared, and the grid on which it is simulated.
    parameters
        Names that the tasks' values stand for.

    Raises
    ------
    ModelError
        If a function of the user's cannot be loaded.
    """

    def __init__(
        self, experiment: Experiment, grid: SignalGrid, parameters: tuple[str, ...]
    ) -> None:
        self._residuals = _residuals(experiment, grid, parameters)
        self.is_plain = all(isinstance(each, MeasuredTimes) for each in self._residuals)
        """True if every residual is (measured - simulated) / sigma of a value of the grid."""
        self._constraints = _constraints(experiment, parameters)

    def compare(self, simulated: SimulatedOutputs) -> BatchComparison:
        """Compare a batch of simulations."""
        failures: dict[int, str] = {}
        residuals = _joined(self._residuals, simulated, failures)
        return BatchComparison(residuals, _joined(self._constraints, simulated, failures), failures)

    def jacobian(self, simulated: SimulatedOutputs, sensitivities: FloatArray) -> FloatArray:
        """Return the (residuals + constraints, parameters) derivatives of one simulation's.

        `sensitivities` are those of its outputs, (parameters, n, names).
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
