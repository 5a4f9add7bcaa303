"""A pattern search whose polls are complete: everything that an iteration wants is one request.

Around the best point, points at a distance of one mesh in each direction of a pattern are polled.
The search moves to the best of them and takes a coarser mesh, or, if none is better, a finer one.
It needs no derivatives, and some direction always leads down where there are any.

References: V. Torczon, On the convergence of pattern search algorithms, SIAM J. Optim. 7 (1997)
1-25, doi:10.1137/S1052623493250780; T. G. Kolda, R. M. Lewis, V. Torczon, Optimization by direct
search: new perspectives on some classical and modern methods, SIAM Review 45 (2003) 385-482,
doi:10.1137/S003614450242889.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Points, Progress, Search, Solution
from cluster_est.methods.pattern_search.options import PatternMethod
from cluster_est.methods.pattern_search.state import PatternState, PollPlan
from cluster_est.methods.sqp.evaluation_cache import worst_constraint
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

NEAR_MINIMUM = 0.1
"""Meshes: where a model's minimum is closer than this, the mesh shrinks by two steps at once."""
WHOLE = 0.99
"""A step of so many meshes counts as one of the pattern."""


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
        What is asked for besides the poll, in the same request: "quadratic", the minima of a model
        through the points polled nearby, which makes the search much faster wherever the cost is
        anything like smooth, and costs two points; "latin_hypercube", points scattered around the
        best, against shallow minima; "none".
    search_points
        How many points a Latin hypercube has; 0 for as many as there are unknowns.
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

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        (at,) = yield Points(space.start[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(space.start, np.nan, Ending.START_FAILED, at.reason)
        state = PatternState(space, self, generator, at)
        mesh = self.initial_mesh
        progress = progress_of(state, 0, mesh, np.nan)
        ending = Ending.CONVERGED if state.satisfied else None
        while ending is None:
            ahead = state.ahead(mesh)
            points = _batch(state, ahead, mesh)
            numbers: list[int] = []
            if len(points):
                x = np.array([state.frame.x(u) for u in points])
                evaluations = yield Points(x, "poll", progress)
                numbers = [state.learn(u, e) for u, e in zip(points, evaluations, strict=True)]
            state.calibrate()
            mesh, length = _next_mesh(state, self, mesh, ahead, numbers)
            if mesh < state.tolerance:
                ending, mesh = state.settle()
            progress = progress_of(state, progress.iteration + 1, mesh, length)
            if state.satisfied:
                ending = Ending.CONVERGED
            elif ending is None and progress.iteration >= self.max_iterations:
                ending = Ending.MAX_ITERATIONS
        return solution_of(state, ending, progress.iteration)


def _batch(state: PatternState, ahead: PollPlan, mesh: float) -> FloatArray:
    """Everything that an iteration asks for."""
    poll = [state.u + mesh * direction for direction in ahead.directions]
    return state.new([*poll, *ahead.promising, *ahead.scattered], ahead.slopes)


def _next_mesh(
    state: PatternState, options: PatternMethod, mesh: float, ahead: PollPlan, numbers: list[int]
) -> tuple[float, float]:
    """Move to the best of what an iteration learnt, if it is better; the next mesh, and how far."""
    best = state.better(numbers)
    if best is None:
        state.fail()
        return shrunk(options, mesh, ahead), 0.0
    length = state.move(best)
    return stepped(options, mesh, length), length


def stepped(options: PatternMethod, mesh: float, length: float) -> float:
    """The mesh after a step of some length that led down."""
    if length >= WHOLE * mesh:
        return options.expansion * mesh
    return min(mesh, max(options.contraction * mesh, 2.0 * length))


def shrunk(options: PatternMethod, mesh: float, ahead: PollPlan) -> float:
    """The mesh after a poll that failed."""
    finer = options.contraction * mesh
    return options.contraction * finer if ahead.model_step < NEAR_MINIMUM else finer


def progress_of(state: PatternState, iteration: int, mesh: float, length: float) -> Progress:
    """A line of the iteration table."""
    violation = state.best.violation if len(state.best.constraints) else np.nan
    return Progress(iteration, state.best.cost, step=length, damping=mesh, violation=violation)


def solution_of(state: PatternState, ending: Ending, iterations: int) -> Solution:
    """The best point as the end of a search."""
    x, at = state.frame.x(state.best_u), state.best
    message = "" if at.feasible else worst_constraint(state.frame.space, at)
    return Solution(x, at.cost, ending, message, iterations, at=at)
