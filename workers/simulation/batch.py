"""A batch of simulations in the core, and the loops that simulate it."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import addressof
from dataclasses import dataclass, field

import numpy as np

from workers.core.library import Batch, Effects, Fmu, Settings, address_of, core
from workers.core.sundials import CvodeIntegrator, libraries
from workers.messages import FloatArray, IntArray, Linearisation
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.jacobian import DirectionalJacobian


@dataclass(frozen=True)
class SimulationBatch:
    """Results of a batch of simulations.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty if the simulation reached its end, otherwise a sentence.
    codes : (points,)
        See `workers.core.failure`.
    steps : (points,)
        Steps of the solver; 0 if unknown.
    linearisations
        By point, if requested and the simulation reached its end.
    sensitivities
        (parameters, times, outputs) by point, if requested and available; NaN for parameters
        without derivatives.
    innovations
        (residuals,) by point, with process noise. They replace the residuals, and `outputs` are
        predictions from one measured time to the next.
    """

    outputs: FloatArray
    messages: list[str]
    codes: IntArray
    steps: IntArray
    linearisations: dict[int, Linearisation] = field(default_factory=dict)
    sensitivities: dict[int, FloatArray] = field(default_factory=dict)
    innovations: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def empty(cls, points: int, times: int, outputs: int) -> SimulationBatch:
        """Return a batch without any results."""
        codes, steps = np.zeros((2, points), np.int64)
        return cls(np.full((points, times, outputs), np.nan), [""] * points, codes, steps)


Loop = Callable[[Batch], int]
"""Simulates points up to the first failure, and returns their number."""


def simulate(batch: Batch) -> int:
    """Simulate with the method of the batch."""
    return int(core().core_simulate(addressof(batch)))


class CvodeLoop:
    """Simulates with CVODE, with one integrator for each number of states, which is reused.

    It must not be called by two threads at a time. `jacobian` may be set before each call; it is
    used if no effects act.

    Raises
    ------
    ModelError
        If CVODE is not available for this platform.
    """

    def __init__(self) -> None:
        libraries()
        self._integrators: dict[int, CvodeIntegrator] = {}
        self.jacobian = DirectionalJacobian()

    def __call__(self, batch: Batch) -> int:
        count = batch.n_states
        if count > 0:
            if count not in self._integrators:
                self._integrators[count] = CvodeIntegrator(count)
            self._integrators[count].use_jacobian(*self.jacobian)
            batch.cvode = self._integrators[count].address
        return simulate(batch)


class BatchRun:
    """A batch of points for a loop.

    Parameters
    ----------
    bound, effects
        The experiment, and the effects that act.
    values : (points, k)
        Values of the parameters.
    bounds : (points,)
        Sums of squares above which simulations end early; None for no bounds.
    step_limit
        Number of steps after which a simulation fails; 0 for no limit.

    Attributes
    ----------
    result
        Results, which the loop writes.
    """

    def __init__(
        self,
        bound: BoundExperiment,
        values: FloatArray,
        effects: Effects,
        bounds: FloatArray | None = None,
        step_limit: int = 0,
    ) -> None:
        self.bound, self.effects, self.values = bound, effects, values
        self.step_limit = step_limit
        count, given = values.shape
        rows = np.array(values, np.float64, order="C")
        if len(bound.known_values) > 0:
            rows = np.empty((count, given + len(bound.known_values)))
            rows[:, :given], rows[:, given:] = values, bound.known_values
        outputs = np.empty((count, bound.structure.n_times, len(bound.outputs)))
        outputs.fill(np.nan)
        self._numbers = numbers = np.zeros((4, count), np.int64)
        self.result = SimulationBatch(outputs, [""] * count, numbers[0], numbers[2])
        self._rows, self._bounds = rows, None if bounds is None else np.array(bounds, np.float64)
        self._rows_at, self._outputs_at = address_of(rows) or 0, address_of(outputs) or 0
        self._numbers_at = address_of(numbers) or 0
        self._bounds_at = address_of(self._bounds) if self._bounds is not None else None

    @property
    def stopped_at(self) -> FloatArray:
        """Times of failures, (points,)."""
        return self._numbers[3].view(np.float64)  # type: ignore[no-any-return]

    def batch(self, first: int, count: int, fmu: Fmu, settings: Settings, method: int) -> Batch:
        """Return the core's structure for some of the points, without progress.

        It is valid as long as this object, the FMU and the settings exist.
        """
        self._chosen_effects = effects = self.effects.from_point(first)
        _, times, width = self.result.outputs.shape
        points, n_values = self._rows.shape
        row = self._numbers_at + 8 * first
        bounds = None if self._bounds_at is None else self._bounds_at + 8 * first
        return Batch(
            addressof(fmu), addressof(self.bound.structure), addressof(settings),
            addressof(effects), method, count, n_values, fmu.n_states + effects.n_states, 0,
            self._rows_at + 8 * first * n_values, bounds, None,
            self._outputs_at + 8 * first * times * width,
            row, row + 8 * points, row + 16 * points, row + 24 * points,
        )  # fmt: skip
