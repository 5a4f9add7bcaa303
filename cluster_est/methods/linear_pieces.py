"""Constraints that are the largest of many values: each linearisation shows one of their faces.

The largest deviation of a signal over time, or the farthest of many points, has kinks where another
time or point takes over. At a kink one linearisation is blind: every step along it runs into the
face that it does not see. So linearisations of the neighbourhood are kept and all of them count, as
the cutting planes of bundle methods do (K. C. Kiwiel, Methods of Descent for Nondifferentiable
Optimization, Lecture Notes in Mathematics 1133 (1985), doi:10.1007/BFb0074500).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.quadratic_program import Model
from workers.messages import FloatArray

REACH = 10.0
"""Linearisations from farther away than this many trust radii do not count."""
JUMP = 10.0
"""A constraint that changes this many times more than its slopes allow has jumped: no face of it
helps."""


@dataclass(frozen=True)
class Piece:
    """Constraints and their slopes at a point."""

    x: FloatArray
    values: FloatArray
    slopes: FloatArray


class Pieces:
    """The latest linearisations of a search; none of them counts before a kink was met."""

    def __init__(self, equality: npt.NDArray[np.bool_], most: int) -> None:
        self._inequalities = np.flatnonzero(~equality).astype(np.intp)
        self._most = most
        self._pieces: list[Piece] = []
        self.active = False

    def add(self, piece: Piece) -> None:
        """Keep a linearisation, and forget the oldest beyond as many as there is room for."""
        if self.active and len(self._inequalities):
            self._pieces = [*self._pieces, piece][-self._most :]

    def extend(self, model: Model, at: FloatArray, reach: FloatArray) -> Model:
        """Add the faces around a point to a model of its neighbourhood.

        No face may claim more than the constraint's value at the point itself.

        Parameters
        ----------
        model
            Its first rows are all constraints at `at`, in their order.
        at : (n,)
            The point.
        reach : (n,)
            The trust radius of each unknown.
        """
        for piece in self._pieces:
            away = at - piece.x
            if np.max(np.abs(away) / reach) > REACH:
                continue
            which = self._inequalities
            values = piece.values + piece.slopes @ away
            model = replace(
                model,
                values=np.append(
                    model.values, np.minimum(values, model.values[: len(values)])[which]
                ),
                slopes=np.vstack([model.slopes, piece.slopes[which]]),
                constraint=np.append(model.constraint, which),
                equality=np.append(model.equality, np.zeros(len(which), dtype=bool)),
            )
        return model


def is_jump(before: Piece, step: FloatArray, after: FloatArray) -> bool:
    """Whether constraints rose more along a step than a kink between two faces explains."""
    excess = after - before.values - before.slopes @ step
    slack = JUMP * (np.abs(before.slopes) @ np.abs(step))
    return bool((excess > slack + 1e-12).any())
