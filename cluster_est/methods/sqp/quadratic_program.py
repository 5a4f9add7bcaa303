"""The convex quadratic program with penalised constraints whose solution is the step of an SQP.

    minimise   g'p + p'Bp / 2 + nu sum_i v_i(p)    subject to    lower <= p <= upper

where v_i is the violation of constraint i: max(0, c_i + a_i p), or |c_i + a_i p| for an equality,
or the largest of several such terms. Because violations are penalised rather than forbidden, it has
a solution also where the linearised constraints contradict each other; where they do not and nu is
large enough, the solution satisfies them exactly (R. Fletcher, Practical Methods of Optimization,
2nd ed. (1987), section 14.3).

It is solved by Mehrotra's predictor-corrector interior-point method (S. Mehrotra, SIAM J. Optim. 2
(1992) 575-601, doi:10.1137/0802028): some 15 factorisations of a matrix as large as there are
unknowns and constraints, however many of them are active.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from workers.messages import FloatArray

MAX_STEPS = 60
ACCURACY = 1e-14
TO_BOUNDARY = 0.995
"""Part of the way to the nearest constraint that an interior step takes."""
FLATTEST = 1e-8
"""A row that changes by a smaller part of its value within the bounds counts as a constant."""


@dataclass(frozen=True)
class QuadraticSubproblem:
    """The program around a point: the cost to second order, constraints to first.

    Attributes
    ----------
    gradient, hessian : (n,), (n, n)
        g and B, the latter positive semidefinite.
    values, jacobian : (rows,), (rows, n)
        c and a.
    constraint : (rows,)
        The constraint that each row is a term of, counted from 0; each has at least one.
    equality : (rows,)
        True if the row must be 0; the others must be at most 0.
    """

    gradient: FloatArray
    hessian: FloatArray
    values: FloatArray
    jacobian: FloatArray
    constraint: npt.NDArray[np.intp]
    equality: npt.NDArray[np.bool_]

    def violation(self, step: FloatArray) -> float:
        """Return the sum of the violations after a step."""
        values = self.values + self.jacobian @ step
        sizes = np.where(self.equality, np.abs(values), values)
        largest = np.zeros(1 + int(self.constraint.max(initial=-1)))
        np.maximum.at(largest, self.constraint, sizes)
        return float(np.add.reduce(largest))

    def change(self, step: FloatArray) -> float:
        """Return the change of the cost by a step."""
        return float(self.gradient @ step + 0.5 * (step @ (self.hessian @ step)))


def penalised_step(
    model: QuadraticSubproblem, penalty: float, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve the program above.

    Parameters
    ----------
    model, penalty
        Its g, B, c, a, and nu.
    lower, upper : (n,)
        Finite, with 0 between or on them. Unknowns whose bounds are the same stay.

    Returns
    -------
    step : (n,)
        p, within the bounds.
    multipliers : (rows,)
        Between 0 and nu, between -nu and nu for equalities.
    """
    free = upper > lower
    step, equality = np.zeros(len(free)), model.equality
    if not free.any():
        return step, np.zeros(len(equality))
    width = (upper - lower)[free]
    program, rows = _scaled(model, penalty, (lower, upper), free)
    p, dual = program.solve()
    step[free] = np.clip(p * width, lower[free], upper[free])
    signed = np.zeros(len(equality) + int(equality.sum()))
    signed[rows.kept] = dual / rows.lengths
    multipliers = signed[: len(equality)].copy()
    multipliers[equality] -= signed[len(equality) :]
    return step, multipliers


@dataclass(frozen=True)
class _KeptRows:
    """The rows of a scaled program, among all inequalities, and what they were divided by."""

    kept: npt.NDArray[np.intp]
    lengths: FloatArray


def _scaled(
    model: QuadraticSubproblem,
    penalty: float,
    bounds: tuple[FloatArray, FloatArray],
    free: npt.NDArray[np.bool_],
) -> tuple[_ScaledProgram, _KeptRows]:
    """Write the program in units of each unknown's range, with rows of length at most 1."""
    lower, upper, equality = bounds[0][free], bounds[1][free], model.equality
    width = upper - lower
    values = np.concatenate([model.values, -model.values[equality]])
    rows = np.vstack([model.jacobian, -model.jacobian[equality]])[:, free] * width
    group = np.concatenate([model.constraint, model.constraint[equality]])
    # a row that is negative wherever the step may go says nothing; as it may be a constant, it
    # would spoil the scale
    highest = values + np.maximum(rows * (lower / width), rows * (upper / width)).sum(axis=1)
    kept = np.flatnonzero(highest > 0.0)
    values, rows, group = values[kept], rows[kept], group[kept]
    lengths = np.zeros(1 + int(model.constraint.max(initial=-1)))
    sizes = np.maximum(np.abs(rows).max(axis=1, initial=0.0), FLATTEST * np.abs(values))
    np.maximum.at(lengths, group, sizes)
    lengths[lengths == 0.0] = 1.0
    program = _ScaledProgram(
        width * model.gradient[free],
        model.hessian[np.ix_(free, free)] * np.outer(width, width),
        rows / lengths[group, None],
        values / lengths[group],
        group,
        penalty * lengths,
        lower / width,
        upper / width,
    )
    return program, _KeptRows(kept, lengths[group])


@dataclass(frozen=True)
class _ScaledProgram:
    """The program in scaled terms, all rows inequalities."""

    gradient: FloatArray
    hessian: FloatArray
    rows: FloatArray
    values: FloatArray
    group: npt.NDArray[np.intp]
    weights: FloatArray
    lower: FloatArray
    upper: FloatArray

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Return the step and the multipliers of the rows.

        The unknowns are those of the step, and one bound t_i >= v_i for each constraint.
        """
        n, m, r = len(self.gradient), len(self.weights), len(self.values)
        # the largest number of the cost is 1, unless the penalty is much larger still
        size = max(np.abs(self.gradient).max(initial=0.0), np.abs(self.hessian).max(initial=0.0))
        size = max(float(size), 1e-6 * float(self.weights.max(initial=0.0))) or 1.0
        hessian = np.zeros((n + m, n + m))
        hessian[:n, :n] = self.hessian / size
        linear = np.concatenate([self.gradient, self.weights]) / size
        identity = np.eye(n + m)
        selection = identity[n:, n:][self.group]
        constraints = np.vstack(
            [np.hstack([self.rows, -selection]), -identity[n:], identity[:n], -identity[:n]]
        )
        limits = np.concatenate([-self.values, np.zeros(m), self.upper, -self.lower])
        # strictly feasible: the middle of the box, t above the violations there, and multipliers
        # that make the Lagrangian's gradient zero, those of the box shifted off zero
        middle = 0.5 * (self.upper + self.lower)
        t = np.zeros(m)
        np.maximum.at(t, self.group, self.values + self.rows @ middle)
        dual_t = 0.5 * self.weights / size
        dual_rows = (dual_t / np.maximum(np.bincount(self.group, minlength=m), 1))[self.group]
        gradient = hessian[:n, :n] @ middle + linear[:n] + self.rows.T @ dual_rows
        shift = 0.1 + 0.1 * np.abs(gradient).max(initial=0.0)
        dual_box = [np.maximum(-gradient, 0.0) + shift, np.maximum(gradient, 0.0) + shift]
        start = np.concatenate([middle, t + 1.0])
        dual = np.concatenate([dual_rows, dual_t, *dual_box])
        solution, dual = _interior_point(hessian, linear, constraints, limits, start, dual)
        return solution[:n], dual[:r] * size


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _interior_point(
    hessian: FloatArray,
    gradient: FloatArray,
    constraints: FloatArray,
    limits: FloatArray,
    x: FloatArray,
    dual: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Minimise x'Hx / 2 + g'x subject to Cx <= l, from a strictly feasible x and dual."""
    slack = limits - constraints @ x
    best = (np.inf, x, dual)
    for _ in range(MAX_STEPS):
        stationarity = hessian @ x + gradient + constraints.T @ dual
        primal = constraints @ x + slack - limits
        gap = float(slack @ dual) / len(limits)
        error = max(gap, np.abs(stationarity).max(), np.abs(primal).max())
        if error < best[0]:
            best = (error, x, dual)
        if error <= ACCURACY or not np.isfinite(error):
            break
        solve = _factorised(hessian + constraints.T @ (constraints * (dual / slack)[:, None]))
        if solve is None:
            break
        newton = _NewtonSystem(constraints, slack, dual, stationarity, primal, solve)
        _, ds, dl = newton.step(np.zeros_like(slack))
        length = min(_step_to_zero(slack, ds), _step_to_zero(dual, dl))
        after = float((slack + length * ds) @ (dual + length * dl)) / len(limits)
        dx, ds, dl = newton.step((after / gap) ** 3 * gap - ds * dl)
        length = TO_BOUNDARY * min(_step_to_zero(slack, ds), _step_to_zero(dual, dl))
        x, slack, dual = x + length * dx, slack + length * ds, dual + length * dl
    return best[1], best[2]


@dataclass(frozen=True)
class _NewtonSystem:
    """The linear system of one interior-point iteration."""

    constraints: FloatArray
    slack: FloatArray
    dual: FloatArray
    stationarity: FloatArray
    primal: FloatArray
    solve: Callable[[FloatArray], FloatArray]

    def step(self, target: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the changes of x, slacks and multipliers towards slack * dual = target."""
        ratio = self.dual / self.slack
        aim = target / self.slack - self.dual
        right = -self.stationarity - self.constraints.T @ (ratio * self.primal + aim)
        dx = self.solve(right)
        ds = -self.primal - self.constraints @ dx
        return dx, ds, aim - ratio * ds


def _factorised(matrix: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    """Return a solver of a positive definite system; None if rounding errors spoil it."""
    scale = 1.0 / np.sqrt(np.diagonal(matrix))
    scaled = matrix * np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        return None
    try:
        factor = cho_factor(scaled)
    except LinAlgError:
        return None

    def solve(right: FloatArray) -> FloatArray:
        return np.asarray(scale * cho_solve(factor, scale * right))

    return solve


def _step_to_zero(values: FloatArray, changes: FloatArray) -> float:
    """Return the part of the changes, at most 1, after which the first value is zero."""
    falling = changes < 0.0
    return float(np.min(-values[falling] / changes[falling], initial=1.0))
