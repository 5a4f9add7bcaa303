"""The last digits of a step: the constraints that it stands at are held, the rest is least squares.

An interior-point method says which constraints are active; a least-squares solution on those is as
exact as the Jacobian allows, where the quadratic program lost half the digits by squaring it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.methods.quadratic_program import Model
from workers.messages import FloatArray

AT_BOUND = 1e-9
CAPPED = 1e-6
RANK = 1e-10
ROUNDS = 5


@dataclass(frozen=True)
class Held:
    """minimise |F q + t|^2 + weight (violations), within bounds.

    Attributes
    ----------
    factor, target
        F and t, damping included.
    model
        The same as a quadratic program, with the constraints.
    weight
        Of the violations.
    lower, upper
        Bounds of q.
    """

    factor: FloatArray
    target: FloatArray
    model: Model
    weight: float
    lower: FloatArray
    upper: FloatArray

    def value(self, step: FloatArray) -> float:
        rest = self.factor @ step + self.target
        return float(np.add.reduce(rest * rest)) + self.weight * self.model.violation(step)


def held_step(
    problem: Held, step: FloatArray, multipliers: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Improve a solution and its multipliers, or return them as they are.

    Parameters
    ----------
    problem
        What is minimised.
    step, multipliers
        A solution of less accuracy.
    """
    held, pushed = _active(problem, step, multipliers)
    width = problem.upper - problem.lower
    low = step - problem.lower <= AT_BOUND * width
    high = problem.upper - step <= AT_BOUND * width
    for _ in range(ROUNDS):
        fixed = np.where(low, problem.lower, np.where(high, problem.upper, 0.0))
        better, found = _on_active(problem, fixed, ~(low | high), held, pushed)
        pull = 2.0 * problem.factor.T @ (problem.factor @ better + problem.target)
        pull += problem.model.slopes.T @ np.where(held, found, pushed)
        wrong = (low & (pull < 0.0)) | (high & (pull > 0.0))
        if not wrong.any():
            break
        low, high = low & ~wrong, high & ~wrong
    inside = np.clip(better, problem.lower, problem.upper)
    slack = 1e-9 * max(problem.value(step), np.finfo(float).tiny)
    if not np.isfinite(better).all() or np.abs(inside - better).max(initial=0.0) > 1e-9 * width.max(initial=0.0):
        return step, multipliers
    if problem.value(inside) > problem.value(step) + slack:
        return step, multipliers
    return inside, np.where(held, found, pushed)


def _active(
    problem: Held, step: FloatArray, multipliers: FloatArray
) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Which constraints the step stands at, and the constant multipliers of violated ones."""
    model, size = problem.model, np.abs(multipliers)
    left = model.values + model.slopes @ step
    lengths = np.linalg.norm(model.slopes, axis=1)
    together = np.bincount(model.constraint, size)
    capped = (together >= (1.0 - CAPPED) * problem.weight)[model.constraint]
    gradient = np.linalg.norm(model.gradient) + float(np.add.reduce(size * lengths))
    reach = np.abs(model.values) + lengths * np.linalg.norm(step)
    pressing = size * lengths * reach >= np.abs(left) * gradient
    held = ~capped & (model.equality | (pressing & (size > 0.0))) & (lengths > 0.0)
    return held, np.where(capped, multipliers, 0.0)


def _on_active(
    problem: Held,
    fixed: FloatArray,
    free: npt.NDArray[np.bool_],
    held: npt.NDArray[np.bool_],
    pushed: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Least squares over the free unknowns on the held constraints, and their multipliers."""
    model = problem.model
    rows = model.slopes[held][:, free]
    sides = -(model.values[held] + model.slopes[held] @ fixed)
    lengths = np.maximum(np.linalg.norm(rows, axis=1), np.finfo(float).tiny)
    left, singular, right = np.linalg.svd(rows / lengths[:, None], full_matrices=True)
    rank = int(np.count_nonzero(singular > RANK * np.max(singular, initial=0.0)))
    pseudo = right[:rank].T * (1.0 / singular[:rank])
    begin = pseudo @ (left[:, :rank].T @ (sides / lengths))
    null = right[rank:].T
    factor, target = problem.factor[:, free], problem.target + problem.factor @ fixed
    linear = (model.slopes.T @ pushed)[free]
    step = fixed.copy()
    basis, triangle = np.linalg.qr(factor @ null)
    aim = -(basis.T @ (target + factor @ begin))
    aim -= 0.5 * np.linalg.solve(triangle.T, null.T @ linear)
    step[free] = begin + null @ np.linalg.solve(triangle, aim)
    rest = 2.0 * factor.T @ (problem.factor @ step + problem.target) + linear
    multipliers = np.zeros(len(held))
    multipliers[held] = -(left[:, :rank] @ (pseudo.T @ rest)) / lengths
    return step, multipliers
