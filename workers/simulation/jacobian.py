"""The Jacobian of an FMU's states from its directional derivatives, and their verification.

They may be zero or wrong without a message, so they are compared with finite differences.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.messages import FloatArray

STATE_DIFFERENCE_STEP = float(np.cbrt(np.finfo(np.float64).eps))
"""Step of a central difference, relative to the size of a state."""
MAX_JACOBIAN_ERROR = 1e-4
"""Largest error of directional derivatives, relative to the largest derivative in their row."""


class DirectionalJacobian(NamedTuple):
    """Value references of states and their derivatives; empty if not available."""

    states: tuple[int, ...] = ()
    derivatives: tuple[int, ...] = ()


@dataclass(frozen=True)
class StateJacobian:
    """Comparison of directional derivatives with finite differences.

    Attributes
    ----------
    error
        The largest difference, relative to the largest derivative of that state derivative.
    zero
        Whether all directional derivatives are 0, but not all finite differences.
    """

    error: float
    zero: bool


def directional_jacobian(description: ModelDescription) -> DirectionalJacobian:
    """Return the references of the Jacobian; empty if the FMU does not declare enough."""
    variables = description.variables
    derivatives = {v.derivative_of: v for v in variables.values() if v.derivative_of}
    if any(name not in derivatives for name in description.states):
        return DirectionalJacobian()
    pairs = [(variables[name], derivatives[name]) for name in description.states]
    if any(v.type != "Float64" or v.size > 1 for pair in pairs for v in pair):
        return DirectionalJacobian()
    return DirectionalJacobian(
        tuple(x.reference for x, _ in pairs), tuple(dx.reference for _, dx in pairs)
    )


def compare_with_differences(
    fmu: Any, version: str, jacobian: DirectionalJacobian
) -> StateJacobian:
    """Compare directional derivatives with finite differences, in continuous-time mode.

    Parameters
    ----------
    fmu
        The instance as an object of fmpy.
    version
        Version of FMI.
    jacobian
        The references of states and derivatives.

    Raises
    ------
    ModelError
        If the FMU fails.
    """
    try:
        return _compare(fmu, version, list(jacobian.derivatives), list(jacobian.states))
    except Exception as error:  # fmpy raises bare exceptions
        raise ModelError(f"the FMU did not provide a directional derivative ({error})") from error


def _compare(fmu: Any, version: str, unknowns: list[int], knowns: list[int]) -> StateJacobian:
    vectors = _StateVectors(fmu, len(knowns), version)
    states = vectors.states()
    directional, differences = np.zeros((2, len(unknowns), len(knowns)))
    for column, known in enumerate(knowns):
        directional[:, column] = fmu.getDirectionalDerivative(unknowns, [known], [1.0])
    for column in range(len(knowns)):
        step = STATE_DIFFERENCE_STEP * max(abs(states[column]), 1.0)
        perturbed = np.tile(states, (2, 1))
        perturbed[:, column] += step, -step
        high, low = (vectors.derivatives_at(x) for x in perturbed)
        differences[:, column] = (high - low) / (perturbed[0, column] - perturbed[1, column])
    sizes = np.maximum(np.abs(differences).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    zero = not directional.any() and bool(differences.any())
    return StateJacobian(float((np.abs(directional - differences) / sizes).max(initial=0.0)), zero)


class _StateVectors:
    """States and their derivatives, for both versions of FMI."""

    def __init__(self, fmu: Any, count: int, version: str) -> None:
        self._fmu, self._count, self._fmi_2 = fmu, count, version == "2.0"

    def states(self) -> FloatArray:
        return self._call("getContinuousStates", np.zeros(self._count))

    def derivatives_at(self, states: FloatArray) -> FloatArray:
        self._call("setContinuousStates", np.ascontiguousarray(states))
        name = "getDerivatives" if self._fmi_2 else "getContinuousStateDerivatives"
        return self._call(name, np.zeros(self._count))

    def _call(self, name: str, values: FloatArray) -> FloatArray:
        pointer = values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        getattr(self._fmu, name)(pointer, self._count)
        return values
