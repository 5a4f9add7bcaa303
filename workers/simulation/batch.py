"""Results of a batch of simulations."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray, IntArray, Linearisation


@dataclass(frozen=True)
class SimulationBatch:
    """Results of a batch of simulations.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty where a simulation reached its end, else a sentence.
    codes : (points,)
        See `workers.kernels.fmi.failure`.
    steps : (points,)
        Steps of the solver; 0 where that is not known.
    linearisations
        By point, where that was asked for and the simulation reached its end.
    sensitivities
        (parameters, times, outputs) by point, where sensitivities were asked for and to be had;
        NaN for parameters by which there are none.
    innovations
        (residuals,) by point, where there is process noise: they take the place of the residuals,
        and `outputs` are predictions from one measured time to the next.
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
        """Make one of which nothing is simulated yet."""
        return cls(
            np.full((points, times, outputs), np.nan),
            [""] * points,
            np.zeros(points, np.int64),
            np.zeros(points, np.int64),
        )
