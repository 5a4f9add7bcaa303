"""A linear time-varying system in discrete time: the matrices of all its steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cluster_est.closed_loop.candidates.step_matrices import StepMatrices, step_matrices
from workers.messages import FloatArray, Linearisation

HELD = 1e-3
"""Largest change of A, over the largest entry of its row, for which the matrices of the last step
hold for the next one: a fifth of what tells a direction from the declared parameters."""


def discretise(linear: Linearisation) -> StepMatrices:
    """Matrices of all steps at once, exact where A is constant within each step."""
    a = np.asarray(linear.A)
    return step_matrices(0.5 * (a[1:] + a[:-1]), np.diff(linear.times))


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
