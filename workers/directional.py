"""Whether the directional derivatives that an FMU offers are the slopes of its own functions."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np

from workers.child import Probe
from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.kernels import failure
from workers.messages import FloatArray

STEP = float(np.cbrt(np.finfo(np.float64).eps))
"""Of a central difference, over the size of a state."""


@dataclass(frozen=True)
class Derivatives:
    """Directional derivatives of the state derivatives by the states, against differences.

    Attributes
    ----------
    error
        The largest difference, over the largest slope of that state derivative.
    zero
        Whether all are 0 where differences are not.
    """

    error: float
    zero: bool


@dataclass(frozen=True)
class Directional(Probe):
    """Asks for them at the end of a simulation, in model exchange."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> Derivatives:
        simulator, description = evaluator.simulator, evaluator.description
        record = simulator.run(self.experiment, self.point[None])
        if record.codes[0] != failure.FINISHED:
            raise ModelError(record.messages[0])
        variables = description.variables
        slopes = {v.derivative_of: v.reference for v in variables.values() if v.derivative_of}
        if any(name not in slopes for name in description.states):
            raise ModelError("it does not say which variables are its state derivatives")
        unknowns = [slopes[name] for name in description.states]
        knowns = [variables[name].reference for name in description.states]
        fmu = simulator.instance.fmu
        try:
            return _compare(fmu, description.version, unknowns, knowns)
        except Exception as error:  # fmpy raises bare exceptions
            raise ModelError(f"asked for one, it failed ({error})") from error


def _compare(fmu: Any, version: str, unknowns: list[int], knowns: list[int]) -> Derivatives:
    vectors = _Vectors(fmu, len(knowns), version)
    states = vectors.states()
    given, taken = np.zeros((2, len(unknowns), len(knowns)))
    for column, known in enumerate(knowns):
        given[:, column] = fmu.getDirectionalDerivative(unknowns, [known], [1.0])
    for column in range(len(knowns)):
        step = STEP * max(abs(states[column]), 1.0)
        moved = np.tile(states, (2, 1))
        moved[:, column] += step, -step
        high, low = (vectors.slopes_at(x) for x in moved)
        taken[:, column] = (high - low) / (moved[0, column] - moved[1, column])
    sizes = np.maximum(np.abs(taken).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    zero = not given.any() and bool(taken.any())
    return Derivatives(float((np.abs(given - taken) / sizes).max(initial=0.0)), zero)


class _Vectors:
    """States and their derivatives, through the calls of either version."""

    def __init__(self, fmu: Any, count: int, version: str) -> None:
        self._fmu, self._count, self._old = fmu, count, version == "2.0"

    def states(self) -> FloatArray:
        return self._call("getContinuousStates", np.zeros(self._count))

    def slopes_at(self, states: FloatArray) -> FloatArray:
        self._call("setContinuousStates", np.ascontiguousarray(states))
        name = "getDerivatives" if self._old else "getContinuousStateDerivatives"
        return self._call(name, np.zeros(self._count))

    def _call(self, name: str, values: FloatArray) -> FloatArray:
        pointer = values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        getattr(self._fmu, name)(pointer, self._count)
        return values
