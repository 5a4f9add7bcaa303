"""The state of a pattern search, and the points that its next poll may request.

Besides the poll's directions, a poll may request minima of quadratic models of the cost and its
constraints. The models interpolate evaluated points. If there are too few points, the model with
the least second derivatives (in the Frobenius norm) is used: A. L. Custodio, H. Rocha,
L. N. Vicente, Incorporating minimum Frobenius norm models in direct search, Comput. Optim. Appl. 46
(2010) 265-278, doi:10.1007/s10589-009-9283-0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.coordinates import ScaledCoordinates
from cluster_est.methods.method import Ending, Evaluation
from cluster_est.methods.pattern_search.augmented_lagrangian import (
    NEGLIGIBLE_VIOLATION,
    AugmentedLagrangian,
    first_lagrangian,
    first_penalty,
)
from cluster_est.methods.pattern_search.poll_directions import (
    PatternMethod,
    aligned_axes,
    directions,
    reflection,
)
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, IntArray

ROUNDING_OF_POINTS = 2.0**-40
"""Distance within which points count as equal, in units of a noticeable change."""


class EvaluatedPoints:
    """Evaluated points in the coordinates of a `ScaledCoordinates`, numbered in their order.

    Parameters
    ----------
    size
        Number of unknowns.
    constraints
        Number of constraints.
    """

    def __init__(self, size: int, constraints: int) -> None:
        self._points = np.empty((64, size))
        self._costs = np.empty(64)
        self._constraints = np.empty((64, constraints))
        self._numbers: dict[bytes, int] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def points(self) -> FloatArray:
        return self._points[: self._count]

    @property
    def costs(self) -> FloatArray:
        """Costs (points,); infinite if a simulation failed."""
        return self._costs[: self._count]

    @property
    def constraints(self) -> FloatArray:
        """Constraints (points, constraints); infinite if a value is undefined."""
        return self._constraints[: self._count]

    def __contains__(self, u: FloatArray) -> bool:
        return key(u) in self._numbers

    def add(self, u: FloatArray, evaluation: Evaluation) -> int:
        """Add a point; return its number."""
        if self._count == len(self._costs):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
            self._costs = np.concatenate([self._costs, np.empty_like(self._costs)])
            self._constraints = np.concatenate(
                [self._constraints, np.empty_like(self._constraints)]
            )
        number = self._count
        cost, found = evaluation.cost, evaluation.constraints
        failed = not evaluation.ok or np.isnan(cost)
        self._points[number] = u
        self._costs[number] = np.inf if failed else cost
        self._constraints[number] = np.inf if failed else np.where(np.isnan(found), np.inf, found)
        self._numbers[key(u)] = number
        self._count += 1
        return number

    @property
    def finite(self) -> npt.NDArray[np.bool_]:
        """True for points with finite cost and constraints, (points,)."""
        return np.isfinite(self.costs) & np.isfinite(self.constraints).all(axis=1)

    def quantities(self, numbers: IntArray) -> FloatArray:
        """Return costs and then constraints of some points, (numbers, 1 + constraints)."""
        return np.column_stack([self.costs[numbers], self.constraints[numbers]])

    def violation(self, number: int, equality: npt.NDArray[np.bool_]) -> float:
        """Return the largest violation of the constraints at a point."""
        found = self.constraints[number]
        return float(np.where(equality, np.abs(found), found).max(initial=0.0))

    def near(self, u: FloatArray, distance: float, most: int) -> IntArray:
        """Return the numbers of points with finite values within a distance of u, nearest first."""
        distances = np.abs(self.points - u).max(axis=1, initial=0.0)
        found = np.flatnonzero(self.finite & (distances <= distance) & (distances > 0.0))
        return found[np.argsort(distances[found], kind="stable")][:most]


def key(u: FloatArray) -> bytes:
    """Return a key that is the same for points that count as equal."""
    return (np.rint(u / ROUNDING_OF_POINTS) + 0.0).tobytes()


CURVATURE_WEIGHT = 1e-5
"""Weight of the second derivatives relative to the errors at the points."""


@dataclass(frozen=True)
class QuadraticModel:
    """Quadratic models v + g s + s H s / 2 of the cost and then of the constraints.

    Attributes
    ----------
    values : (functions,)
        v.
    gradients : (functions, unknowns)
        g.
    hessians : (functions, unknowns, unknowns)
        H.
    """

    values: FloatArray
    gradients: FloatArray
    hessians: FloatArray

    def predicted(self, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return costs (steps,) and constraints (steps, constraints) at steps (steps, unknowns)."""
        h_s = np.einsum("qij,kj->kqi", self.hessians, steps)
        values = self.values + steps @ self.gradients.T + 0.5 * np.einsum("kqi,ki->kq", h_s, steps)
        return values[:, 0], values[:, 1:]

    def minimum(
        self, lagrangian: AugmentedLagrangian, lower: FloatArray, upper: FloatArray
    ) -> FloatArray:
        """Return the step s within bounds that minimises the model's augmented Lagrangian."""
        from scipy.optimize import minimize  # imported here because the import is slow

        start = float(lagrangian.values(self.values[0], self.values[1:]))
        gradient = self.gradients[0] + lagrangian.shifted(self.values[1:]) @ self.gradients[1:]
        scale = float(np.abs(gradient).max() + np.abs(self.hessians[0]).max()) or 1.0

        def merit(s: FloatArray) -> tuple[float, FloatArray]:
            h_s = self.hessians @ s
            values = self.values + self.gradients @ s + 0.5 * (h_s @ s)
            gradients = self.gradients + h_s
            constraints = values[1:]
            value = float(lagrangian.values(values[0], constraints)) - start
            gradient = gradients[0] + lagrangian.shifted(constraints) @ gradients[1:]
            return value / scale, gradient / scale

        found = minimize(
            merit,
            np.zeros(len(lower)),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([lower, upper]),
            options={"ftol": 1e-15, "gtol": 1e-12, "maxiter": 200},
        )
        step: FloatArray = np.clip(found.x, lower, upper)
        return step


def fit_model(base: FloatArray, steps: FloatArray, changes: FloatArray) -> QuadraticModel:
    """Return the model that interpolates `base` and fits the other points as well as possible.

    Parameters
    ----------
    base : (functions,)
        Values at s = 0.
    steps : (points, unknowns)
        Steps to the other points, of order 1.
    changes : (points, functions)
        Values at the steps minus the values at s = 0.
    """
    size = steps.shape[1]
    rows, columns = np.triu_indices(size)
    # the square of a coefficient is its part of the squared Frobenius norm
    factors = np.where(rows == columns, 0.5, np.sqrt(0.5))
    design = np.concatenate([steps, steps[:, rows] * steps[:, columns] * factors], axis=1)
    # the error of a quadratic grows with the third power of the distance
    weights = 1.0 / np.maximum(1.0, np.abs(steps).max(axis=1)) ** 3
    penalty = np.zeros((len(rows), design.shape[1]))
    penalty[:, size:] = CURVATURE_WEIGHT * np.eye(len(rows))
    left = np.concatenate([design * weights[:, None], penalty])
    right = np.concatenate([changes * weights[:, None], np.zeros((len(rows), len(base)))])
    found = np.linalg.lstsq(left, right, rcond=1e-13)[0]
    hessians = np.zeros((len(base), size, size))
    coefficients = found[size:].T * np.where(rows == columns, 0.5, np.sqrt(0.5))
    hessians[:, rows, columns] += coefficients
    hessians[:, columns, rows] += coefficients
    return QuadraticModel(base, np.ascontiguousarray(found[:size].T), hessians)


MODEL_RADIUS = 4.0
"""Largest distance of the points of a model, in meshes."""
MODEL_STEPS = (1.0, 3.0)
"""Bounds of the minima of a model, in meshes."""
HYPERCUBE_RADIUS = 4.0
"""Distance from the centre of the poll to the sides of the Latin hypercube, in meshes."""
FINER, COARSER = 0.1, 2.0
"""Factor of the tolerance after an update of the multipliers; first mesh over the old tolerance."""
DIVERGED = 10.0
"""Violation relative to the start's above which the penalty is too small."""
LARGEST_PENALTY = 1e12
"""Largest penalty, relative to the first penalty."""


@dataclass(frozen=True)
class PollPlan:
    """The points around a centre that a poll may request, in scaled coordinates.

    Attributes
    ----------
    promising : (points, unknowns)
        A point along the last step, and the minima of a model.
    directions : (directions, unknowns)
        Directions of the poll, of unit length, in the order of a model's values.
    sample : (points, unknowns)
        Points of a Latin hypercube.
    model_step
        Distance of the model's minimum within one mesh, in meshes; infinite without a model.
    constraint_jacobian : (constraints on parameters, unknowns)
        Jacobian of the constraints on parameters, for `PatternState.new`.
    """

    promising: FloatArray
    directions: FloatArray
    sample: FloatArray
    model_step: float
    constraint_jacobian: FloatArray


class PatternState:
    """The centre of the poll, all evaluated points, the axes and the augmented Lagrangian.

    Parameters
    ----------
    space, options, generator
        Space, options and random number generator of the search.
    at
        The evaluation of the start.

    Attributes
    ----------
    best, best_u
        The best evaluation by rank, and its point. The centre of the poll may differ: it has the
        least augmented Lagrangian.
    tolerance
        Call `at_tolerance` if the mesh is below this.
    """

    def __init__(
        self,
        space: SearchSpace,
        options: PatternMethod,
        generator: np.random.Generator,
        at: Evaluation,
    ) -> None:
        self.coordinates = ScaledCoordinates(space)
        self.evaluated = EvaluatedPoints(space.size, len(space.equality))
        self.best, self.best_u = at, np.zeros(space.size)
        self.tolerance = options.mesh_tolerance
        if len(space.equality):
            self.tolerance = max(self.tolerance, COARSER * FINER * options.initial_mesh)
        self._lagrangian = first_lagrangian(
            space.equality, self.coordinates.parameter_constraint_count
        )
        self._first_penalty = np.nan
        self._options = options
        self._generator = generator
        self._axes = np.eye(space.size)
        self._last_failure = np.zeros(space.size)
        self._last_step = np.zeros(space.size)
        self._centre = self.add(self.best_u, at)
        self._start_violation = at.violation

    @property
    def u(self) -> FloatArray:
        """The centre of the poll."""
        found: FloatArray = self.evaluated.points[self._centre]
        return found

    def add(self, u: FloatArray, evaluation: Evaluation) -> int:
        """Add an evaluation; return the number of its point."""
        if evaluation.rank < self.best.rank:
            self.best, self.best_u = evaluation, u.copy()
        return self.evaluated.add(u, evaluation)

    def better(self, numbers: list[int]) -> int | None:
        """Return the best of some points, if it is better than the centre of the poll."""
        values = self._lagrangian.values(self.evaluated.costs, self.evaluated.constraints)
        found = min(numbers, key=lambda number: float(values[number]), default=self._centre)
        return found if values[found] < values[self._centre] else None

    def move(self, number: int) -> float:
        """Move the centre of the poll; return the length of the step."""
        self._last_step = self.evaluated.points[number] - self.u
        self._centre = number
        self._restrain()
        return float(np.abs(self._last_step).max())

    def poll_failed(self) -> None:
        """Rotate the axes and discard the last step, after a poll without a better point."""
        self._last_step = np.zeros_like(self._last_step)
        progress = self.u - self._last_failure
        self._last_failure = self.u.copy()
        if self._options.axes == "aligned":
            self._axes = aligned_axes(progress)
        elif self._options.axes == "random":
            self._axes = reflection(self._generator.standard_normal(len(progress)))

    @property
    def feasible_point_suffices(self) -> bool:
        """True if there is no cost to minimise and the constraints are satisfied."""
        return self.best.feasible and not len(self.best.residuals)

    @property
    def calibrated(self) -> bool:
        """True if there is a penalty, so that points can be compared."""
        return not len(self._lagrangian.equality) or bool(np.isfinite(self._first_penalty))

    def calibrate(self) -> None:
        """Choose the penalty from the evaluated points, if it is not chosen yet."""
        if self.calibrated:
            return
        finite = self.evaluated.finite
        if finite.any():
            costs, constraints = self.evaluated.costs[finite], self.evaluated.constraints[finite]
            self._first_penalty = first_penalty(costs, constraints)
            self._lagrangian = replace(self._lagrangian, penalty=self._first_penalty)
            self._take_best()

    def at_tolerance(self) -> tuple[Ending | None, float]:
        """Return an ending, or None and a new mesh; call it if the mesh is below `tolerance`."""
        finest = self._options.mesh_tolerance
        lagrangian, constraints = self._lagrangian, self.evaluated.constraints[self._centre]
        if (
            self.tolerance <= finest
            and lagrangian.constraint_error(constraints) <= NEGLIGIBLE_VIOLATION
        ):
            return Ending.CONVERGED, finest
        self._lagrangian = lagrangian.updated(constraints)
        if not self._lagrangian.penalty <= LARGEST_PENALTY * self._first_penalty:
            return Ending.STALLED if self.best.feasible else Ending.INFEASIBLE, finest
        mesh = COARSER * self.tolerance
        self.tolerance = max(finest, FINER * self.tolerance)
        self._take_best()
        return None, mesh

    def plan(self, mesh: float) -> PollPlan:
        """Return the points around the centre that may be requested."""
        normals, jacobian = self.coordinates.normals_near(self.u, mesh)
        steps = directions(self._axes, self._options.basis, normals)
        model = self._model(mesh)
        promising = [self.u + self._options.expansion * self._last_step]
        model_step = np.inf
        if model is not None:
            minima = [self._minimum(model, mesh, meshes) for meshes in MODEL_STEPS]
            model_step = float(np.abs(minima[0] - self.u).max()) / mesh
            promising += minima
            values = self._lagrangian.values(*model.predicted(steps))
            steps = steps[np.argsort(values, kind="stable")]
        if not self.coordinates.is_feasible(self.u):
            promising.append(self.u)  # `new` projects it
        return PollPlan(
            self.new(promising, jacobian),
            steps,
            self.new(self._sample(mesh), jacobian),
            model_step,
            jacobian,
        )

    def new(self, candidates: list[FloatArray], jacobian: FloatArray) -> FloatArray:
        """Return candidates, projected on bounds and constraints on parameters, that are new.

        A candidate that cannot be projected is left out, unless the centre of the poll violates
        the constraints itself.
        """
        strict = self.coordinates.is_feasible(self.u)
        found: dict[bytes, FloatArray] = {}
        for candidate in candidates:
            u = self.coordinates.projected(candidate, jacobian)
            if u is None and not strict:
                u = self.coordinates.clip(candidate)
            if u is not None and u not in self.evaluated:
                found.setdefault(key(u), u)
        return np.array(list(found.values())).reshape(-1, len(self.u))

    def _take_best(self) -> None:
        values = self._lagrangian.values(self.evaluated.costs, self.evaluated.constraints)
        self._centre = int(np.argmin(values))
        self._last_step = np.zeros_like(self._last_step)

    def _restrain(self) -> None:
        """Raise the penalty if the search diverges from the constraints."""
        if np.isnan(self._first_penalty):
            return
        most = DIVERGED * max(1.0, self._start_violation)
        while (
            self.evaluated.violation(self._centre, self._lagrangian.equality) > most
            and self._lagrangian.penalty < LARGEST_PENALTY * self._first_penalty
        ):
            self._lagrangian = self._lagrangian.stronger()
            self._take_best()

    def _model(self, mesh: float) -> QuadraticModel | None:
        """Return a quadratic model in units of the mesh; None with too few evaluated points."""
        if self._options.search_step != "quadratic" or not self.evaluated.finite[self._centre]:
            return None
        size = len(self.u)
        needed = (size + 1) * (size + 2) // 2  # coefficients of a quadratic
        chosen = self.evaluated.near(self.u, MODEL_RADIUS * mesh, needed * 3 // 2)
        if len(chosen) < size:
            return None
        base = self.evaluated.quantities(np.array([self._centre]))[0]
        steps = (self.evaluated.points[chosen] - self.u) / mesh
        return fit_model(base, steps, self.evaluated.quantities(chosen) - base)

    def _minimum(self, model: QuadraticModel, mesh: float, meshes: float) -> FloatArray:
        lower = np.maximum(-meshes, (self.coordinates.lower - self.u) / mesh)
        upper = np.minimum(meshes, (self.coordinates.upper - self.u) / mesh)
        return self.u + mesh * model.minimum(self._lagrangian, lower, upper)

    def _sample(self, mesh: float) -> list[FloatArray]:
        if self._options.search_step != "latin_hypercube":
            return []
        size = len(self.u)
        count = self._options.search_points or size
        cells = self._generator.permuted(np.tile(np.arange(count), (size, 1)), axis=1).T
        sample = (cells + self._generator.random((count, size))) / count
        return list(self.u + HYPERCUBE_RADIUS * mesh * (2.0 * sample - 1.0))
