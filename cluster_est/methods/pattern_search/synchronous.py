"""A pattern search with complete polls: all points of an iteration are one request.

A poll evaluates points around the best point, one mesh away in each direction of a pattern. If one
of them is better, the search moves to the best and coarsens the mesh. Otherwise it refines the
mesh. It needs no derivatives. If descent directions exist, the pattern contains one of them.

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
"""Distance of a model's minimum, in meshes, below which the mesh is contracted twice."""
FULL_STEP = 0.99
"""Least length of a step of the pattern, in meshes."""


@dataclass(frozen=True)
class PatternSearch(PatternMethod):
    """Generalised pattern search with complete polls.

    Use it for costs without derivatives: with noise, jumps, or occasional failed simulations. It
    uses the cost only, not residuals. It supports bounds, constraints on parameters (without
    simulations), and constraints on signals, including equalities. For a smooth sum of squares,
    `least_squares` needs a tenth of the evaluations. If simulation times differ widely, use
    `asynchronous_pattern_search`. It finds one local minimum, which depends on the start. A coarse
    initial mesh skips shallow minima.

    Attributes
    ----------
    basis
        "2n" polls both directions of each axis. "n+1" polls towards the corners of a simplex, with
        about half the evaluations, and is less reliable at edges of the cost. Near bounds and
        constraints on parameters, polls always use directions along them, both ways.
    axes
        "aligned": the first axis is along the progress since the last failed poll; follows narrow
        valleys. Without progress the axes are the coordinates. "coordinates": always the
        coordinates, for independent parameters. "random": new random axes after each failed poll,
        from the seed. Try "random" if the search ends too early at an edge.
    search_step
        Further points in the same request as the poll. "quadratic": two minima of a quadratic model
        through nearby points; much faster if the cost is nearly smooth. "latin_hypercube": points
        scattered around the best point, to escape from shallow minima. "none": no further points.
    search_points
        Number of points of a Latin hypercube; 0 selects the number of unknowns.
    initial_mesh
        The first mesh, in noticeable changes. A noticeable change is the start value itself, or 1
        in a logarithm, but at most the range of the bounds. If the start is 0, it is a tenth of
        this range.
    mesh_tolerance
        Converged when a poll fails with a mesh finer than this.
    expansion, contraction
        Factors of the mesh after a step of the pattern, and after a failed poll.
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
    """Return the mesh after a failed poll."""
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
