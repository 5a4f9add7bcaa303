"""Where a pattern search stands, and what it could ask for next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import Ending, Evaluation
from cluster_est.methods.coordinates import ScaledCoordinates
from cluster_est.methods.pattern_search.augmented_lagrangian import (
    CLOSE,
    first_lagrangian,
    first_penalty,
)
from cluster_est.methods.pattern_search.bases import aligned_axes, directions, reflection
from cluster_est.methods.pattern_search.evaluated_points import EvaluatedPoints, key
from cluster_est.methods.pattern_search.options import PatternMethod
from cluster_est.methods.pattern_search.quadratic_model import (
    QuadraticModel,
    fit_model,
    points_needed,
)
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

MODEL_REACH = 4.0
"""The model is made of points within so many meshes,"""
MODEL_STEPS = (1.0, 3.0)
"""and its minima within each of these many are asked for."""
HYPERCUBE_REACH = 4.0
"""Meshes from the best point to the sides of the Latin hypercube."""
TIGHTER, SLACKER = 0.1, 2.0
"""With new multipliers the mesh must become this much finer, from this much coarser than that."""
ESCAPED = 10.0
"""A search that violates constraints so much more than it began with has too little penalty."""
LARGEST_PENALTY = 1e12
"""Times the first one."""


@dataclass(frozen=True)
class PollPlan:
    """What could be asked for around a point, in the coordinates of the frame.

    Attributes
    ----------
    promising : (points, unknowns)
        Further along the last step, and where a model has its minima.
    directions : (directions, unknowns)
        Of the poll, of unit length, those first in which a model goes down most.
    scattered : (points, unknowns)
        Of a Latin hypercube.
    model_step
        Meshes to the nearer of the model's minima; infinite without a model.
    slopes : (constraints on parameters, unknowns)
        For `PatternState.new`.
    """

    promising: FloatArray
    directions: FloatArray
    scattered: FloatArray
    model_step: float
    slopes: FloatArray


class PatternState:
    """The point that is polled around, all that is known, and what to do next.

    Parameters
    ----------
    space, options, generator
        Of the search.
    at
        The evaluation of the start.

    Attributes
    ----------
    best, best_u
        The best evaluation by rank, and where; the point that is polled around is the one whose
        augmented Lagrangian is least.
    tolerance
        The mesh at which `settle` is to be asked what follows.
    """

    def __init__(
        self,
        space: SearchSpace,
        options: PatternMethod,
        generator: np.random.Generator,
        at: Evaluation,
    ) -> None:
        self.frame = ScaledCoordinates(space)
        self.polled = EvaluatedPoints(space.size, len(space.equality))
        self.best, self.best_u = at, np.zeros(space.size)
        self.tolerance = options.mesh_tolerance
        if len(space.equality):
            self.tolerance = max(self.tolerance, SLACKER * TIGHTER * options.initial_mesh)
        self._lagrangian = first_lagrangian(space.equality, self.frame.tied)
        self._first_penalty = np.nan
        self._options = options
        self._generator = generator
        self._axes = np.eye(space.size)
        self._turned_at = np.zeros(space.size)
        self._last_step = np.zeros(space.size)
        self._number = self.learn(self.best_u, at)
        self._start_violation = at.violation

    @property
    def u(self) -> FloatArray:
        found: FloatArray = self.polled.points[self._number]
        return found

    def learn(self, u: FloatArray, evaluation: Evaluation) -> int:
        """Remember an evaluation; the number of its point."""
        if evaluation.rank < self.best.rank:
            self.best, self.best_u = evaluation, u.copy()
        return self.polled.add(u, evaluation)

    def better(self, numbers: list[int]) -> int | None:
        """The best of some points, if it is better than the one that is polled around."""
        values = self._lagrangian.values(self.polled.costs, self.polled.constraints)
        found = min(numbers, key=lambda number: float(values[number]), default=self._number)
        return found if values[found] < values[self._number] else None

    def move(self, number: int) -> float:
        """Poll around another point; how far it is from the last one."""
        self._last_step = self.polled.points[number] - self.u
        self._number = number
        self._hold_back()
        return float(np.abs(self._last_step).max())

    def fail(self) -> None:
        """Note that no direction led down at some mesh: turn the axes, forget the last step."""
        self._last_step = np.zeros_like(self._last_step)
        progress = self.u - self._turned_at
        self._turned_at = self.u.copy()
        if self._options.axes == "aligned":
            self._axes = aligned_axes(progress)
        elif self._options.axes == "random":
            self._axes = reflection(self._generator.standard_normal(len(progress)))

    @property
    def satisfied(self) -> bool:
        """Whether nothing was to be found but a point that satisfies the constraints, and is."""
        return self.best.feasible and not len(self.best.residuals)

    @property
    def calibrated(self) -> bool:
        """Whether points can be compared already."""
        return not len(self._lagrangian.equality) or bool(np.isfinite(self._first_penalty))

    def calibrate(self) -> None:
        """Choose the penalty, once some points around the start are known."""
        if self.calibrated:
            return
        known = self.polled.finite
        if known.any():
            costs, constraints = self.polled.costs[known], self.polled.constraints[known]
            self._first_penalty = first_penalty(costs, constraints)
            self._lagrangian = replace(self._lagrangian, penalty=self._first_penalty)
            self._take_best()

    def settle(self) -> tuple[Ending | None, float]:
        """What follows where the mesh has become as fine as `tolerance`: the end, or a new mesh."""
        finest = self._options.mesh_tolerance
        lagrangian, constraints = self._lagrangian, self.polled.constraints[self._number]
        if self.tolerance <= finest and lagrangian.missing(constraints) <= CLOSE:
            return Ending.CONVERGED, finest
        self._lagrangian = lagrangian.updated(constraints)
        if not self._lagrangian.penalty <= LARGEST_PENALTY * self._first_penalty:
            return Ending.STALLED if self.best.feasible else Ending.INFEASIBLE, finest
        mesh = SLACKER * self.tolerance
        self.tolerance = max(finest, TIGHTER * self.tolerance)
        self._take_best()
        return None, mesh

    def ahead(self, mesh: float) -> PollPlan:
        """What could be asked for around the point."""
        near, slopes = self.frame.near(self.u, mesh)
        steps = directions(self._axes, self._options.basis, near)
        model = self._model(mesh)
        found = [self.u + self._options.expansion * self._last_step]
        model_step = np.inf
        if model is not None:
            minima = [self._minimum(model, mesh, meshes) for meshes in MODEL_STEPS]
            model_step = float(np.abs(minima[0] - self.u).max()) / mesh
            found += minima
            values = self._lagrangian.values(*model.predicted(steps))
            steps = steps[np.argsort(values, kind="stable")]
        if not self.frame.allowed(self.u):
            found.append(self.u)  # which is repaired
        return PollPlan(
            self.new(found, slopes),
            steps,
            self.new(self._scattered(mesh), slopes),
            model_step,
            slopes,
        )

    def new(self, candidates: list[FloatArray], slopes: FloatArray) -> FloatArray:
        """Candidates moved to where bounds and constraints on parameters allow them, if unknown.

        A candidate that cannot be moved there is left out, unless the point that is polled around
        is not allowed itself.
        """
        strict = self.frame.allowed(self.u)
        found: dict[bytes, FloatArray] = {}
        for candidate in candidates:
            u = self.frame.repaired(candidate, slopes)
            if u is None and not strict:
                u = self.frame.clip(candidate)
            if u is not None and u not in self.polled:
                found.setdefault(key(u), u)
        return np.array(list(found.values())).reshape(-1, len(self.u))

    def _take_best(self) -> None:
        values = self._lagrangian.values(self.polled.costs, self.polled.constraints)
        self._number = int(np.argmin(values))
        self._last_step = np.zeros_like(self._last_step)

    def _hold_back(self) -> None:
        """Raise the penalty if the search goes off to where the constraints count for nothing."""
        if np.isnan(self._first_penalty):
            return
        most = ESCAPED * max(1.0, self._start_violation)
        while (
            self.polled.violation(self._number, self._lagrangian.equality) > most
            and self._lagrangian.penalty < LARGEST_PENALTY * self._first_penalty
        ):
            self._lagrangian = self._lagrangian.stronger()
            self._take_best()

    def _model(self, mesh: float) -> QuadraticModel | None:
        """A quadratic model, in steps of a mesh from the point, or None if too little is known."""
        if self._options.search_step != "quadratic" or not self.polled.finite[self._number]:
            return None
        size = len(self.u)
        chosen = self.polled.around(self.u, MODEL_REACH * mesh, points_needed(size) * 3 // 2)
        if len(chosen) < size:
            return None
        base = self.polled.quantities(np.array([self._number]))[0]
        steps = (self.polled.points[chosen] - self.u) / mesh
        return fit_model(base, steps, self.polled.quantities(chosen) - base)

    def _minimum(self, model: QuadraticModel, mesh: float, meshes: float) -> FloatArray:
        lower = np.maximum(-meshes, (self.frame.lower - self.u) / mesh)
        upper = np.minimum(meshes, (self.frame.upper - self.u) / mesh)
        return self.u + mesh * model.minimum(self._lagrangian, lower, upper)

    def _scattered(self, mesh: float) -> list[FloatArray]:
        if self._options.search_step != "latin_hypercube":
            return []
        size = len(self.u)
        count = self._options.search_points or size
        cells = self._generator.permuted(np.tile(np.arange(count), (size, 1)), axis=1).T
        sample = (cells + self._generator.random((count, size))) / count
        return list(self.u + HYPERCUBE_REACH * mesh * (2.0 * sample - 1.0))
