"""A pattern search with complete polls: all points of an iteration are one request.

Around the best point, points at a distance of one mesh in each direction of a pattern are polled.
The search moves to the best of them and takes a coarser mesh, or, if none is better, a finer one.
It needs no derivatives, and some direction is always one of descent where there are any.

References: V. Torczon, On the convergence of pattern search algorithms, SIAM J. Optim. 7 (1997)
1-25, doi:10.1137/S1052623493250780; T. G. Kolda, R. M. Lewis, V. Torczon, Optimization by direct
search: new perspectives on some classical and modern methods, SIAM Review 45 (2003) 385-482,
doi:10.1137/S003614450242889.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.method import Ending, Points, Progress, Search, Solution, worst_constraint
from cluster_est.methods.pattern_search.poll_directions import PatternMethod
from cluster_est.methods.pattern_search.state import PatternState, PollPlan
from cluster_est.problem.search_space import SearchSpace

NEAR_MINIMUM = 0.1
"""Distance of a model's minimum, in meshes, below which the mesh is contracted twice at once."""
FULL_STEP = 0.99
"""Length of a step, in meshes, from which on it counts as one of the pattern."""


@dataclass(frozen=True)
class PatternSearch(PatternMethod):
    """Generalised pattern search with complete polls.

    For costs that have no derivatives: with noise, with jumps, with simulations that fail here and
    there, of any kind (it looks at the cost, not at residuals). It keeps bounds, constraints on
    parameters, which cost no simulation, and constraints on signals, also equalities. Not for a
    smooth sum of squares, where `least_squares` needs a tenth of the evaluations; not where
    simulations take very different times, for which there is `asynchronous_pattern_search`. It
    finds the minimum that the start leads to; a coarse initial mesh skips shallow ones.

    Attributes
    ----------
    basis
        "2n" polls both ways along each axis, "n+1" towards the corners of a simplex: about half
        of the evaluations, and less reliable where the cost has edges. Next to bounds and
        constraints on parameters the directions always follow these, both ways.
    axes
        "aligned": the first axis along the progress since the last poll that failed, and the
        coordinates where there was none; follows narrow valleys. "coordinates": always those; for
        parameters that act independently of each other. "random": others after each poll that
        failed, from the seed; to try where the search ends too early at an edge.
    search_step
        Further points in the same request as the poll: "quadratic", the minima of a model
        through the points polled nearby, which makes the search much faster wherever the cost is
        anything like smooth, and costs two points; "latin_hypercube", points scattered around the
        best, against shallow minima; "none".
    search_points
        Number of points of a Latin hypercube; 0 for as many as there are unknowns.
    initial_mesh
        The first mesh, in noticeable changes: of the start value itself, of 1 in a logarithm, of
        the range of the bounds if that is less, or of a tenth of it where the start is 0.
    mesh_tolerance
        Converged when a poll fails with a mesh finer than this.
    expansion, contraction
        By what the mesh is multiplied after a step of the pattern, and after a poll that failed.
    max_iterations
        Limit on the number of polls.
    """

    name: ClassVar[str] = "pattern_search"

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        (at,) = yield Points(space.start[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(space.start, np.nan, Ending.START_FAILED, at.reason)
        state = PatternState(space, self, generator, at)
        mesh = self.initial_mesh
        progress = progress_of(state, 0, mesh, np.nan)
        ending = Ending.CONVERGED if state.feasible_point_suffices else None
        while ending is None:
            plan = state.plan(mesh)
            poll = [state.u + mesh * direction for direction in plan.directions]
            candidates = [*poll, *plan.promising, *plan.sample]
            points = state.new(candidates, plan.constraint_jacobian)
            numbers: list[int] = []
            if len(points):
                x = np.array([state.coordinates.x(u) for u in points])
                evaluations = yield Points(x, "poll", progress)
                numbers = [state.add(u, e) for u, e in zip(points, evaluations, strict=True)]
            state.calibrate()
            best = state.better(numbers)
            if best is None:
                state.poll_failed()
                mesh, length = contracted(self, mesh, plan), 0.0
            else:
                length = state.move(best)
                mesh = mesh_after_step(self, mesh, length)
            if mesh < state.tolerance:
                ending, mesh = state.at_tolerance()
            progress = progress_of(state, progress.iteration + 1, mesh, length)
            if state.feasible_point_suffices:
                ending = Ending.CONVERGED
            elif ending is None and progress.iteration >= self.max_iterations:
                ending = Ending.MAX_ITERATIONS
        return solution_of(state, ending, progress.iteration)


def mesh_after_step(options: PatternMethod, mesh: float, length: float) -> float:
    """Return the mesh after a successful step of some length."""
    if length >= FULL_STEP * mesh:
        return options.expansion * mesh
    return min(mesh, max(options.contraction * mesh, 2.0 * length))


def contracted(options: PatternMethod, mesh: float, plan: PollPlan) -> float:
    """Return the mesh after a poll that failed."""
    finer = options.contraction * mesh
    return options.contraction * finer if plan.model_step < NEAR_MINIMUM else finer


def progress_of(state: PatternState, iteration: int, mesh: float, length: float) -> Progress:
    """Return a line of the iteration table."""
    violation = state.best.violation if len(state.best.constraints) else np.nan
    return Progress(iteration, state.best.cost, step=length, damping=mesh, violation=violation)


def solution_of(state: PatternState, ending: Ending, iterations: int) -> Solution:
    """Return the best point as the solution of a search."""
    x, at = state.coordinates.x(state.best_u), state.best
    message = "" if at.feasible else worst_constraint(state.coordinates.space, at)
    return Solution(x, at.cost, ending, message, iterations, at=at)
