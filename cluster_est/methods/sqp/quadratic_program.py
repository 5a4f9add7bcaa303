"""The convex quadratic program with penalised constraints whose solution is the step of an SQP.

    minimise   g'p + p'Bp / 2 + nu sum_i v_i(p)    subject to    lower <= p <= upper

v_i is the violation of constraint i: max(0, c_i + a_i p), or |c_i + a_i p| for an equality, or the
largest of several such terms. Because violations are penalised, the program has a solution even if
the linearised constraints are inconsistent. If they are consistent and nu is large enough, the
solution satisfies them exactly (R. Fletcher, Practical Methods of Optimization, 2nd ed. (1987),
section 14.3).

PIQP solves the program by a proximal interior-point method (R. Schwan, Y. Jiang, D. Kuhn,
C. N. Jones, 2023, doi:10.48550/arXiv.2304.00290). It takes about 15 factorisations of a matrix as
large as the number of unknowns and constraints. The number does not depend on the active
constraints. The Hessian may be singular, and constraints may be redundant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import piqp

from workers.messages import FloatArray

MAX_STEPS = 100
ACCURACY = 1e-14
LEAST_REGULARISATION = 1e-13, 1e-15
"""Least regularisation of PIQP in normal operation, and in its final refinement.

With PIQP's own limits, a thousand times as large, twice as many random programs end short of their
minimum."""
FLATTEST = 1e-8
"""A row that changes by a smaller part of its value within the bounds counts as constant."""

Box = tuple[FloatArray, FloatArray]
"""Lower and upper bounds."""


@dataclass(frozen=True)
class QuadraticSubproblem:
    """The program around a point: cost to second order, constraints to first order.

    Attributes
    ----------
    gradient, hessian : (n,), (n, n)
        g and B; B is positive semidefinite.
    values, jacobian : (rows,), (rows, n)
        c and a.
    constraint : (rows,)
        Index of the constraint that each row is a term of. Each constraint has at least one row.
    equality : (rows,)
        True if the row must be 0; the other rows must be at most 0.
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
    """Solve the quadratic program with penalised constraints.

    Parameters
    ----------
    model, penalty
        g, B, c and a of the program, and nu.
    lower, upper : (n,)
        Finite bounds of the step that contain 0. Unknowns with equal bounds stay.

    Returns
    -------
    step : (n,)
        p, within the bounds.
    multipliers : (rows,)
        Multipliers between 0 and nu; between -nu and nu for equalities.
    """
    free, equality = upper > lower, model.equality
    step, signed = np.zeros(len(free)), np.zeros(len(equality) + int(equality.sum()))
    if free.any():
        # scale each unknown by its range
        width = (upper - lower)[free]
        box = lower[free] / width, upper[free] / width
        gradient = width * model.gradient[free]
        hessian = model.hessian[np.ix_(free, free)] * np.outer(width, width)
        rows = _scaled_rows(model, free, width, box)
        p, dual = _minimise(gradient, hessian, rows, penalty * rows.lengths, box)
        step[free] = np.clip(p * width, lower[free], upper[free])
        signed[rows.kept] = dual / rows.lengths[rows.group]
    multipliers = signed[: len(equality)].copy()
    multipliers[equality] -= signed[len(equality) :]
    return step, multipliers


@dataclass(frozen=True)
class _ScaledRows:
    """Scaled rows of constraints; an equality has its rows with either sign.

    Attributes
    ----------
    kept
        Indices of the kept rows among all rows.
    group
        Index of the constraint of each row.
    lengths
        Divisor of each constraint's rows. The longest row then has length 1.
    values, jacobian
        Value of each row, and its derivatives by the free unknowns in units of their ranges.
    """

    kept: npt.NDArray[np.intp]
    group: npt.NDArray[np.intp]
    lengths: FloatArray
    values: FloatArray
    jacobian: FloatArray


def _scaled_rows(
    model: QuadraticSubproblem, free: npt.NDArray[np.bool_], width: FloatArray, box: Box
) -> _ScaledRows:
    equality = model.equality
    values = np.concatenate([model.values, -model.values[equality]])
    rows = np.vstack([model.jacobian, -model.jacobian[equality]])[:, free] * width
    group = np.concatenate([model.constraint, model.constraint[equality]])
    # drop rows that are negative within all bounds: they have no effect, and constant rows among
    # them would distort the scale
    highest = values + np.maximum(rows * box[0], rows * box[1]).sum(axis=1)
    kept = np.flatnonzero(highest > 0.0)
    values, rows, group = values[kept], rows[kept], group[kept]
    lengths = np.zeros(1 + int(model.constraint.max(initial=-1)))
    sizes = np.maximum(np.abs(rows).max(axis=1, initial=0.0), FLATTEST * np.abs(values))
    np.maximum.at(lengths, group, sizes)
    lengths[lengths == 0.0] = 1.0
    return _ScaledRows(kept, group, lengths, values / lengths[group], rows / lengths[group, None])


def _minimise(
    gradient: FloatArray, hessian: FloatArray, rows: _ScaledRows, weights: FloatArray, box: Box
) -> tuple[FloatArray, FloatArray]:
    """Return the scaled step and the multipliers of the rows.

    PIQP's variables are the step and one upper bound t_i >= v_i for each constraint.
    """
    n, m = len(gradient), len(weights)
    # scale the largest coefficient of the cost to 1, unless the penalty is much larger
    size = max(np.abs(gradient).max(), np.abs(hessian).max(), 1e-6 * weights.max(initial=0.0))
    size = size or 1.0
    quadratic = np.zeros((n + m, n + m))
    quadratic[:n, :n] = hessian / size
    solver = piqp.DenseSolver()
    settings = solver.settings
    settings.max_iter, settings.preconditioner_scale_cost = MAX_STEPS, True
    settings.eps_abs = settings.eps_duality_gap_abs = ACCURACY
    settings.eps_rel = settings.eps_duality_gap_rel = 0.0
    settings.reg_lower_limit, settings.reg_finetune_lower_limit = LEAST_REGULARISATION
    solver.setup(
        quadratic,
        np.append(gradient, weights) / size,
        G=np.hstack([rows.jacobian, -np.eye(m)[rows.group]]),
        h_u=-rows.values,
        x_l=np.append(box[0], np.zeros(m)),
        x_u=np.append(box[1], np.full(m, np.inf)),
    )
    solver.solve()  # the status is ignored: rounding errors may prevent the full accuracy
    found = solver.result
    return np.nan_to_num(found.x[:n]), np.nan_to_num(found.z_u * size)  # 0 in place of NaN
