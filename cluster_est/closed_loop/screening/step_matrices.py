"""Matrices of the steps of a linear time-varying system, for forcing that is linear in each step.

With Z = h A, dx' = phi_0(Z) dx + h (phi_1(Z) - phi_2(Z)) f + h phi_2(Z) f', where phi_0 is the
exponential and phi_k(Z) = Z phi_(k + 1)(Z) + I / k!.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from workers.messages import FloatArray, Linearisation

HELD = 1e-3
"""Largest change of A, over the largest entry of its row, for which the matrices of the last step
hold for the next one: a fifth of what tells a direction from the declared parameters."""

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


def discretise(linear: Linearisation) -> StepMatrices:
    """Matrices of all steps at once, exact where A is constant within each step.

    C. F. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395-404, doi:10.1109/TAC.1978.1101743.
    """
    a = np.asarray(linear.A)
    h = np.diff(linear.times)
    x = a.shape[1]
    mean = 0.5 * (a[1:] + a[:-1])
    joined = np.zeros((len(h), 3 * x, 3 * x))
    eye: npt.NDArray[np.float64] = np.eye(x)
    joined[:, :x, :x] = mean * h[:, None, None]
    joined[:, :x, x : 2 * x] = eye * h[:, None, None]
    joined[:, x : 2 * x, 2 * x :] = eye
    powers = expm(joined)
    last = powers[:, :x, 2 * x :]
    parts = powers[:, :x, :x], powers[:, :x, x : 2 * x] - last, last
    return StepMatrices(*(np.ascontiguousarray(part) for part in parts))


def streamed_steps(linear: Linearisation, *, backwards: bool = False) -> Iterator[StepMatrices]:
    """Give the matrices of each step in turn, or from the last one on.

    They are made anew where A has changed by more than `HELD`, or the step by more than rounding.
    The steps where that happens are the same in both directions of time, so that one is the adjoint
    of the other.
    """
    h = np.diff(linear.times)
    values = 0.5 * (linear.A.values[1:] + linear.A.values[:-1])
    made = _made_at(linear, h, values)
    first = -1
    step: StepMatrices | None = None
    for k in range(len(h) - 1, -1, -1) if backwards else range(len(h)):
        if step is None or made[k] != first:
            first = made[k]
            a = np.zeros(linear.A.shape[1:])
            a[linear.A.rows, linear.A.columns] = values[first]
            step = step_matrices(a, float(h[first]))
        yield step


def _made_at(linear: Linearisation, h: FloatArray, values: FloatArray) -> list[int]:
    """The step whose matrices hold for each step: itself, or the one where they were made last."""
    largest = linear.A.largest().max(axis=1)[linear.A.rows]
    most = HELD * np.maximum(largest, np.finfo(float).tiny)
    found = [0]
    for k in range(1, len(h)):
        last = found[-1]
        same = abs(h[k] - h[last]) <= 1e-9 * h[last]
        same = same and bool((np.abs(values[k] - values[last]) <= most).all())
        found.append(last if same else k)
    return found


def step_matrices(a: FloatArray, h: float) -> StepMatrices:
    """Matrices of one step, by scaling and squaring of phi_2.

    B. Skaflestad, W. M. Wright, Appl. Numer. Math. 59 (2009) 783-799,
    doi:10.1016/j.apnum.2008.03.035, with the Taylor series in the place of their rational function:
    phi_1(2 Z) = (phi_0 phi_1 + phi_1) / 2 and phi_2(2 Z) = (phi_0 phi_2 + phi_1 + phi_2) / 4.
    """
    eye: npt.NDArray[np.float64] = np.eye(len(a))
    size = float(np.abs(h * a).sum(axis=1).max(initial=0.0))
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
