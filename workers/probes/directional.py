"""Check of an FMU's directional derivatives against differences of its own functions."""

from __future__ import annotations

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
