"""Linearisations of constraints that are the largest of many smooth functions.

The largest deviation of a signal over time, or the farthest of many points, follows one time or
point as the unknowns change, until another takes over. There it has a kink, and the best point is
often on the kink. A linearisation from one side shows one of the smooth functions only: every step
along it violates the other one, is rejected, and the trust region shrinks to nothing although the
cost decreases along the kink.

So, once a step was rejected in this way, the derivatives at its end are asked for, too. They show
the other function. From then on the constraint counts as the largest of its linearisations
here and at the last points around, as the cutting planes of bundle methods do (K. C. Kiwiel,
Methods of Descent for Nondifferentiable Optimization, Lecture Notes in Mathematics 1133 (1985),
doi:10.1007/BFb0074500). Before a kink was met only those of the point itself count, because old
linearisations of smooth, curved constraints may cut off points that satisfy them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem
from workers.messages import FloatArray

LARGEST_DISTANCE = 10.0
"""Linearisations from farther away than this many trust radii do not count."""
JUMP = 10.0
"""A constraint that changes this many times more than its derivatives allow is discontinuous: no
linearisation of it helps."""


@dataclass(frozen=True)
class ConstraintLinearisation:
    """Constraints and their Jacobian at a point."""

    x: FloatArray
    values: FloatArray
    jacobian: FloatArray


class LinearisationHistory:
    """The latest linearisations of a search; none of them counts before a kink was met."""

    def __init__(self, equality: npt.NDArray[np.bool_], most: int) -> None:
        self._inequalities = np.flatnonzero(~equality).astype(np.intp)
        self._most = most
        self._linearisations: list[ConstraintLinearisation] = []
        self.active = False

    def add(self, linearisation: ConstraintLinearisation) -> None:
        """Keep a linearisation, and drop the oldest beyond the largest number."""
        if self.active and len(self._inequalities):
            self._linearisations = [*self._linearisations, linearisation][-self._most :]

    def extend(
        self, model: QuadraticSubproblem, x: FloatArray, radii: FloatArray
    ) -> QuadraticSubproblem:
        """Return the model around a point, with the linearisations at other points near it.

        None of them may exceed the constraint's value at the point itself, which is the largest of
        all functions there: where that of a curved one does, it is lowered.

        Parameters
        ----------
        model
            Its first rows are all constraints at `x`, in their order.
        x : (n,)
            The point.
        radii : (n,)
            The trust radius of each unknown.
        """
        rows = self._inequalities
        c = model.values[rows]
        near = [
            p for p in self._linearisations if np.max(np.abs(x - p.x) / radii) <= LARGEST_DISTANCE
        ]
        values = [np.minimum((p.values + p.jacobian @ (x - p.x))[rows], c) for p in near]
        count = len(near) * len(rows)
        return replace(
            model,
            values=np.concatenate([model.values, *values]),
            jacobian=np.vstack([model.jacobian, *(p.jacobian[rows] for p in near)]),
            constraint=np.append(model.constraint, np.tile(rows, len(near))),
            equality=np.append(model.equality, np.zeros(count, dtype=bool)),
        )


def is_jump(before: ConstraintLinearisation, step: FloatArray, after: FloatArray) -> bool:
    """Return whether constraints rose more along a step than a kink explains."""
    excess = after - before.values - before.jacobian @ step
    allowed = JUMP * (np.abs(before.jacobian) @ np.abs(step))
    return bool((excess > allowed + 1e-12).any())
