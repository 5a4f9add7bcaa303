"""The time of a simulation with sensitivities, beside one without."""

from __future__ import annotations

import time
from dataclasses import dataclass

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.kernels.fmi import failure
from workers.messages import FloatArray
from workers.probes.base import FmuProbe
from workers.simulation.jacobian import (
    StateJacobian,
    compare_with_differences,
    directional_jacobian,
)

REPEATS = 2
"""The quicker of so many counts: the first has something to prepare."""


@dataclass(frozen=True)
class SensitivityCost:
    """Seconds of a simulation.

    Attributes
    ----------
    plain, carrying
        Without and with the derivatives by all parameters.
    """

    plain: float
    carrying: float


@dataclass(frozen=True)
class SensitivityCostProbe(FmuProbe):
    """Times both ways at one point of an experiment; no answer where there are none."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> SensitivityCost | None:
        simulator, points = evaluator.simulator, self.point[None]
        plain, carrying = [], []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            simulator.run(self.experiment, points)
            middle = time.perf_counter()
            found = simulator.sensitivities(self.experiment, points)
            plain.append(middle - begin)
            carrying.append(time.perf_counter() - middle)
            if not found.sensitivities:
                return None
        return SensitivityCost(min(plain), min(carrying))


@dataclass(frozen=True)
class DirectionalProbe(FmuProbe):
    """Asks for them at the end of a simulation, in model exchange."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> StateJacobian:
        simulator, description = evaluator.simulator, evaluator.description
        record = simulator.run(self.experiment, self.point[None])
        if record.codes[0] != failure.FINISHED:
            raise ModelError(record.messages[0])
        jacobian = directional_jacobian(description)
        if len(jacobian.states) < len(description.states):
            raise ModelError("it does not say which variables are its state derivatives")
        return compare_with_differences(simulator.instance.fmu, description.version, jacobian)
