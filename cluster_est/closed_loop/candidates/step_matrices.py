"""Matrices of a step of a linear system, for forcing that is linear in the step.

With Z = h A, dx' = phi_0(Z) dx + h (phi_1(Z) - phi_2(Z)) f + h phi_2(Z) f', where phi_0 is the
exponential and phi_k(Z) = Z phi_(k + 1)(Z) + I / k!.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt

from workers.core.library import core
from workers.messages import FloatArray

TERMS = 12
"""Of the Taylor series of phi_2: at a norm of 1/2 the first that is left out is below rounding."""


@dataclass(frozen=True)
class StepMatrices:
    """A system in discrete time: dx' = keep dx + from_first f + from_last f'.

    Each is (x, x) for one step, and (n - 1, x, x) for all of them.
    """

    keep: FloatArray
    from_first: FloatArray
    from_last: FloatArray


def step_matrices(a: FloatArray, h: float | FloatArray) -> StepMatrices:
    """Matrices of one step, or of many at once, by scaling and squaring of phi_2.

    B. Skaflestad, W. M. Wright, Appl. Numer. Math. 59 (2009) 783-799,
    doi:10.1016/j.apnum.2008.03.035, with the Taylor series in the place of their rational function:
    phi_1(2 Z) = (phi_0 phi_1 + phi_1) / 2 and phi_2(2 Z) = (phi_0 phi_2 + phi_1 + phi_2) / 4.

    Parameters
    ----------
    a : (x, x)
        Or (n, x, x), of each step its own.
    h
        The step, or (n,) steps.
    """
    h = np.asarray(h)[..., None, None]
    eye: npt.NDArray[np.float64] = np.eye(a.shape[-1])
    size = float(np.abs(h * a).sum(axis=-1).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300)))) + 1)
    z = h * a / 2.0**halvings
    phi_2 = eye / factorial(TERMS + 2)
    for k in range(TERMS + 1, 1, -1):
        phi_2 = z @ phi_2 + eye / factorial(k)
    phi_1 = z @ phi_2 + eye
    phi_0 = z @ phi_1 + eye
    for _ in range(halvings):
        phi_2 = 0.25 * (phi_0 @ phi_2 + phi_1 + phi_2)
        phi_1 = 0.5 * (phi_0 @ phi_1 + phi_1)
        phi_0 = phi_0 @ phi_0
    return StepMatrices(phi_0, h * (phi_1 - phi_2), h * phi_2)


def propagate(steps: StepMatrices, forcing: FloatArray) -> FloatArray:
    """Integrate d(dx)/dt = A dx + f from dx = 0.

    Parameters
    ----------
    steps
        The system.
    forcing : (n, x, m)
        m right-hand sides at every time of the grid, linear in between. The states take their
        place.

    Returns
    -------
    (n, x, m)
    """
    return run_recursion("core_run_linear", steps, forcing)


def run_recursion(name: str, steps: StepMatrices, values: FloatArray) -> FloatArray:
    """Run a recursion of the core over (n, x, m) values, which its results take the place of."""
    values = np.ascontiguousarray(values)
    matrices = [np.ascontiguousarray(m) for m in (steps.keep, steps.from_first, steps.from_last)]
    n, x, m = values.shape
    scratch = np.empty((2, x, m))
    getattr(core(), name)(*(a.ctypes.data for a in (*matrices, values, scratch)), n, x, m)
    return values
