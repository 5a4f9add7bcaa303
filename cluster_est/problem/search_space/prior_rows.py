"""The residuals of priors among those of the experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cluster_est.problem.search_space.unknown import Unknown
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class KnownPrior:
    """The prior of an unknown that is fixed, as along a profile: it counts and does not move.

    Attributes
    ----------
    before
        The unknown before which it would stand.
    experiment
        Position of the experiment that it is counted with.
    residual
        Of the value at which it is fixed.
    """

    before: int
    experiment: int
    residual: float


@dataclass(frozen=True)
class PriorRows:
    """The priors of a space, each behind the residuals of one experiment.

    A prior counts once: with the first of the experiments that its unknown acts on. So it moves
    with no other experiment than the unknown does, and a difference or a colour sees it.

    Attributes
    ----------
    unknowns, known
        Of the space.
    count
        Number of experiments.
    """

    unknowns: Sequence[Unknown] = field(repr=False)
    known: Sequence[KnownPrior]
    count: int

    def __bool__(self) -> bool:
        return any(len(own) for own in self.places)

    @cached_property
    def places(self) -> tuple[IntArray, ...]:
        """For each experiment the unknowns whose priors are counted with it; -1 for known ones."""
        own: list[tuple[float, int, int]] = [
            (float(i), i, unknown.experiments[0])
            for i, unknown in enumerate(self.unknowns)
            if unknown.prior is not None and unknown.experiments
        ]
        own += [(known.before - 0.5, -1, known.experiment) for known in self.known]
        found: list[list[int]] = [[] for _ in range(self.count)]
        for _, i, e in sorted(own):
            found[e].append(i)
        return tuple(np.array(each, dtype=np.intp) for each in found)

    def residuals(self, e: int, x: FloatArray) -> FloatArray:
        """(priors,): of an experiment, at a point in search coordinates."""
        known = (each.residual for each in self.known if each.experiment == e)
        return np.array(
            [
                self.unknowns[i].prior_residual(float(x[i])) if i >= 0 else next(known)
                for i in self.places[e].tolist()
            ],
            np.float64,
        )

    def jacobian(self, e: int, x: FloatArray, acting: IntArray) -> FloatArray:
        """(priors, acting): their derivatives by the unknowns that act on the experiment."""
        own = self.places[e]
        slopes = [
            self.unknowns[i].prior_slope(float(x[i])) if i >= 0 else 0.0 for i in own.tolist()
        ]
        return np.where(own[:, None] == acting, np.array(slopes, np.float64)[:, None], 0.0)

    def among(self, rows: Sequence[slice]) -> np.ndarray:
        """(residuals,): whether each is that of a prior; `rows` are those of each experiment."""
        result = np.zeros(rows[-1].stop if rows else 0, dtype=bool)
        for row, own in zip(rows, self.places, strict=True):
            result[row.stop - len(own) : row.stop] = True
        return result
