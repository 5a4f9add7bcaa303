"""Constraints that are the largest of many values: each linearisation shows one of their faces.

The largest deviation of a signal over time, or the farthest of many points, follows one time or
point as the unknowns change, until another takes over. There it has a kink, and the best point is
often in the crease between the two faces that meet. Derivatives from one side show one face only:
every step along it runs into the other face, is rejected, and the trust region shrinks to nothing
although the crease leads on downhill.

So, once a step was spoiled in this way, the derivatives at the end of that step are asked for, too.
They show the other face. From then on the constraint counts as the largest of its linearisations
here and at the last points around, as the cutting planes of bundle methods do (K. C. Kiwiel,
Methods of Descent for Nondifferentiable Optimization, Lecture Notes in Mathematics 1133 (1985),
doi:10.1007/BFb0074500). Before a kink was met only those of the point itself count, because old
linearisations of smooth, bent constraints may cut off points that satisfy them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem
from workers.messages import FloatArray

REACH = 10.0
"""Linearisations from farther away than this many trust radii do not count."""
JUMP = 10.0
"""A constraint that changes this many times more than its slopes allow has jumped: no face of it
helps."""


@dataclass(frozen=True)
class ConstraintLinearisation:
    """Constraints and their slopes at a point."""

    x: FloatArray
    values: FloatArray
    slopes: FloatArray


class LinearisationHistory:
    """The latest linearisations of a search; none of them counts before a kink was met."""

    def __init__(self, equality: npt.NDArray[np.bool_], most: int) -> None:
        self._inequalities = np.flatnonzero(~equality).astype(np.intp)
        self._most = most
        self._pieces: list[ConstraintLinearisation] = []
        self.active = False

    def add(self, piece: ConstraintLinearisation) -> None:
        """Keep a linearisation, and forget the oldest beyond as many as there is room for."""
        if self.active and len(self._inequalities):
            self._pieces = [*self._pieces, piece][-self._most :]

    def extend(
        self, model: QuadraticSubproblem, at: FloatArray, reach: FloatArray
    ) -> QuadraticSubproblem:
        """Add the faces around a point to a model of its neighbourhood.

        No face may claim more than the constraint's value at the point itself, which is the largest
        of all faces there: where a bent face does, it is lowered.

        Parameters
        ----------
        model
            Its first rows are all constraints at `at`, in their order.
        at : (n,)
            The point.
        reach : (n,)
            The trust radius of each unknown.
        """
        which = self._inequalities
        here = model.values[which]
        near = [p for p in self._pieces if np.max(np.abs(at - p.x) / reach) <= REACH]
        faces = [np.minimum((p.values + p.slopes @ (at - p.x))[which], here) for p in near]
        count = len(near) * len(which)
        return replace(
            model,
            values=np.concatenate([model.values, *faces]),
            slopes=np.vstack([model.slopes, *(p.slopes[which] for p in near)]),
            constraint=np.append(model.constraint, np.tile(which, len(near))),
            equality=np.append(model.equality, np.zeros(count, dtype=bool)),
        )


def is_jump(before: ConstraintLinearisation, step: FloatArray, after: FloatArray) -> bool:
    """Whether constraints rose more along a step than a kink between two faces explains."""
    excess = after - before.values - before.slopes @ step
    slack = JUMP * (np.abs(before.slopes) @ np.abs(step))
    return bool((excess > slack + 1e-12).any())
