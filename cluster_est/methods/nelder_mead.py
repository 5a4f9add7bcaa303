"""The simplex search of Nelder and Mead, serial or with several vertices moved at once.

The method reflects the worst vertex of a simplex at the centre of the other vertices. If the
reflection is a new best point, the method tries a longer move. If the reflection does not help, it
tries a shorter move. If no move helps, the simplex shrinks.

References: J. A. Nelder, R. Mead, A simplex method for function minimization, Comput. J. 7 (1965)
308-313, doi:10.1093/comjnl/7.4.308. Several vertices at once: D. Lee, M. Wiswall, A parallel
implementation of the simplex function minimization routine, Comput. Econ. 30 (2007) 171-187,
doi:10.1007/s10614-007-9094-2. Coefficients by the number of unknowns: F. Gao, L. Han, Implementing
the Nelder-Mead simplex algorithm with adaptive parameters, Comput. Optim. Appl. 51 (2012) 259-277,
doi:10.1007/s10589-010-9329-3. Restart after a collapse away from a minimum: C. T. Kelley, Detection
and remediation of stagnation in the Nelder-Mead algorithm using a sufficient decrease condition,
SIAM J. Optim. 10 (1999) 43-55, doi:10.1137/S1052623497315203. Here, a poll around the best vertex
detects the collapse.

With one unknown the method brackets a minimum and then calls `scipy.optimize.minimize_scalar`.
SciPy's bounded method combines golden section with parabolas: R. P. Brent, Algorithms for
Minimization without Derivatives, Prentice-Hall 1973.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.callback_bridge import Ask, search_in_thread
from cluster_est.methods.coordinates import ScaledCoordinates
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.search_space import SearchSpace
from cluster_est.toml import dotted
from workers.messages import FloatArray


@dataclass(frozen=True)
class SimplexVertex:
    """A point in the coordinates of a `ScaledCoordinates`, and its evaluation."""

    u: FloatArray
    at: Evaluation = field(repr=False)

    @property
    def cost(self) -> float:
        """Cost without constraints; infinite if a simulation failed."""
        return self.at.rank[1]


@dataclass(frozen=True)
class VertexMoves:
    """Coefficients of the moves of a vertex along its line through the centre of the others.

    A coefficient is a distance from the centre, relative to the vertex's distance from the centre.
    It is negative on the far side. `shrink` is the factor of all distances from the best vertex if
    no move helps.
    """

    reflect: float = -1.0
    expand: float = -2.0
    outside: float = -0.5
    inside: float = 0.5
    shrink: float = 0.5

    @property
    def along(self) -> tuple[float, ...]:
        """All moves that `path` may yield."""
        return self.reflect, self.expand, self.outside, self.inside

    def path(
        self, vertex: SimplexVertex, fixed: list[SimplexVertex]
    ) -> Generator[float, SimplexVertex, SimplexVertex]:
        """Yield the moves of a vertex one after the other; return the final vertex.

        The final vertex is `vertex` itself if no move is better. `fixed` holds the vertices that
        do not move, best first.
        """
        reflected = yield self.reflect
        if reflected.cost < fixed[0].cost:
            expanded = yield self.expand
            return expanded if expanded.cost < reflected.cost else reflected
        if reflected.cost < fixed[-1].cost:
            return reflected
        if reflected.cost < vertex.cost:
            contracted = yield self.outside
            return contracted if contracted.cost <= reflected.cost else vertex
        contracted = yield self.inside
        return contracted if contracted.cost < vertex.cost else vertex

    @classmethod
    def adaptive(cls, size: int) -> VertexMoves:
        """Return the coefficients of Gao and Han; the classical ones for up to two unknowns."""
        n = max(size, 2)
        contraction = 0.75 - 0.5 / n
        return cls(-1.0, -1.0 - 2.0 / n, -contraction, contraction, 1.0 - 1.0 / n)


def axis_points(coordinates: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """Return points a step up and down each axis, within bounds: (unknowns, 2, unknowns)."""
    steps = step * np.eye(len(u))
    return coordinates.clip(np.stack([u + steps, u - steps], axis=1))


def corners(coordinates: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """Return one point on each axis, on the side with the longer step: (unknowns, unknowns)."""
    both = axis_points(coordinates, u, step)
    lengths = np.abs(both - u).max(axis=2)
    further: FloatArray = both[np.arange(len(u)), np.argmax(lengths, axis=1)]
    return further


def diameter(simplex: list[SimplexVertex]) -> float:
    """Return the largest distance of a vertex from the first, along any axis."""
    return max(float(np.abs(v.u - simplex[0].u).max()) for v in simplex)


def spread(simplex: list[SimplexVertex]) -> float:
    """Return the difference of the costs of the last vertex and the first."""
    return simplex[-1].cost - simplex[0].cost


def ordered(vertices: Iterable[SimplexVertex]) -> list[SimplexVertex]:
    """Return the vertices, best first; vertices of equal cost keep their order."""
    return sorted(vertices, key=lambda v: v.cost)


LEAST_TOLERANCE = 1e-12
"""Least tolerance of the line search; SciPy does not end with a tolerance of 0."""


class _LineSearch:
    """Search for a minimum in one unknown.

    If both bounds are finite, it searches the interval between them. It searches around the start
    only if the start was better than every point of the interval. Otherwise it goes downhill from
    the start, with steps that double, until the cost rises or a bound is reached.

    Parameters
    ----------
    space
        Search space with one unknown.
    start
        Evaluation at the start of the space.
    step
        First step downhill, in noticeable changes.
    xtol
        Tolerance of the minimum, in noticeable changes.
    max_evaluations
        Approximate limit on the number of evaluations.
    """

    def __init__(
        self, space: SearchSpace, start: Evaluation, step: float, xtol: float, max_evaluations: int
    ) -> None:
        self._coordinates, self._step = ScaledCoordinates(space), step
        self._xtol, self._left = max(xtol, LEAST_TOLERANCE), max_evaluations
        self._start = self._best = SimplexVertex(np.zeros(1), start)
        self._progress = Progress(0, start.cost)

    def solve(self, ask: Ask) -> Solution:
        lower, upper = float(self._coordinates.lower[0]), float(self._coordinates.upper[0])
        converged = False
        if np.isfinite(upper - lower):
            converged = self._between(ask, lower, upper)
        if self._best is self._start:
            converged = self._between(ask, *self._bracket(ask, lower, upper))
        for bound in (lower, upper):
            if 0.0 < abs(self._best.u[0] - bound) <= 3.0 * self._xtol:
                self._costs(ask, [bound], "bound")
        best = self._best
        return Solution(
            self._coordinates.x(best.u),
            best.cost,
            Ending.CONVERGED if converged else Ending.MAX_ITERATIONS,
            iterations=self._progress.iteration,
            at=best.at,
        )

    def _between(self, ask: Ask, low: float, high: float) -> bool:
        """Search an interval; return whether the search converged."""
        from scipy.optimize import minimize_scalar  # imported here because the import is slow

        if not self._left > 0:
            return False
        with np.errstate(all="ignore"):  # differences of infinite costs
            result = minimize_scalar(
                lambda u: self._costs(ask, [float(u)], "trial")[0],
                bounds=(low, high),
                method="bounded",
                options={"xatol": self._xtol, "maxiter": self._left},
            )
        return bool(result.status != 1)

    def _bracket(self, ask: Ask, lower: float, upper: float) -> tuple[float, float]:
        """Step downhill from the start; return two points with a minimum between them."""
        step = self._step
        ends = [max(-step, lower), min(step, upper)]
        costs = self._costs(ask, ends, "bracket")
        if min(costs) >= self._start.cost:
            return ends[0], ends[1]
        upwards = int(costs[1] < costs[0])
        previous, current, cost = 0.0, ends[upwards], costs[upwards]
        limit = (lower, upper)[upwards]
        while current != limit and self._left > 0:
            step *= 2.0
            trial = float(np.clip(current + (step if upwards else -step), lower, upper))
            (trial_cost,) = self._costs(ask, [trial], "bracket")
            if trial_cost >= cost:
                return min(previous, trial), max(previous, trial)
            previous, current, cost = current, trial, trial_cost
        return min(previous, current), max(previous, current)

    def _costs(self, ask: Ask, at: list[float], purpose: str) -> list[float]:
        """Return the costs at points; infinite if a simulation failed."""
        u = np.array(at)[:, None]
        evaluations = ask(Points(self._coordinates.x(u), purpose, self._progress))
        found = [SimplexVertex(*pair) for pair in zip(u, evaluations, strict=True)]
        before = self._best
        self._best = min([before, *found], key=lambda v: v.cost)
        self._left -= len(found)
        self._progress = Progress(
            self._progress.iteration + 1, self._best.cost, float(abs(self._best.u - before.u)[0])
        )
        return [v.cost for v in found]


NEGLIGIBLE_SIMPLEX = 1e-3
"""Part of `xtol`: a smaller simplex has converged even if its costs differ, as at a jump."""
COLLAPSES = (
    "after every restart, the simplex collapsed at a point where a poll step still lowers the "
    'cost; raise method.options.max_restarts, or use method "pattern_search"'
)


@dataclass(frozen=True)
class NelderMead(Method):
    """Simplex search; with one unknown, bounded scalar minimisation.

    Use it for up to about ten unknowns and a cost of any kind. It needs no derivatives, and
    tolerates a little noise and occasional failed simulations. It finds one local minimum, which
    depends on the start. For a smooth sum of squares, `least_squares` needs far fewer evaluations.
    At jumps or edges of the cost the simplex collapses easily; use `pattern_search` there. It does
    not support constraints.

    With one unknown, bounds are always kept, and only `initial_step`, `xtol` and `max_iterations`
    matter.

    Attributes
    ----------
    bounds
        "refuse": report an error if an unknown has bounds. "enforce": move points outside the
        bounds onto the bounds. If a minimum lies on many bounds, prefer `pattern_search`.
    parallel
        Number of worst vertices that are moved at once, at most half the number of unknowns: more
        let the simplex collapse. 1 is the classical method. With four unknowns or more, 2 takes
        about half the rounds for about as many simulations. Use 2 if there are more workers than
        experiments. Higher numbers are rarely better.
    speculative
        Evaluate a vertex's reflection, expansion and both contractions at once. The search takes
        the same path in fewer rounds with more simulations. Use it if the number of workers is at
        least four times `parallel` times the number of experiments.
    coefficients
        "adaptive": coefficients that depend on the number of unknowns. They prevent a collapse at
        edges and with many unknowns, and are the classical coefficients for two unknowns.
        "classical": always the classical coefficients. They save up to a quarter of the evaluations
        with three or four unknowns and a smooth cost.
    initial_step
        Edges of the first simplex, in noticeable changes. A noticeable change is the start value
        itself, or 1 in a logarithm. If the start is 0, it is a tenth of the range of the bounds.
    xtol, ftol
        Converged when two conditions hold. No vertex is further from the best than `xtol`
        noticeable changes. None is worse by more than `ftol` of the best cost (or by the square of
        `ftol`, of the start's cost).
    max_restarts
        Largest number of restarts. A poll in both directions along each axis checks a converged
        simplex. If the poll lowers the cost, the search restarts there with a larger simplex. 0
        disables the poll.
    max_iterations
        Limit on the number of iterations over all restarts.
    """

    name: ClassVar[str] = "nelder_mead"
    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False

    bounds: Literal["refuse", "enforce"] = "refuse"
    parallel: int = field(default=1, metadata={"least": 1})
    speculative: bool = False
    coefficients: Literal["adaptive", "classical"] = "adaptive"
    initial_step: float = field(default=0.25, metadata={"least": 1e-9})
    xtol: float = field(default=1e-6, metadata={"least": 0.0})
    ftol: float = field(default=1e-8, metadata={"least": 0.0})
    max_restarts: int = field(default=10, metadata={"least": 0})
    max_iterations: int = field(default=5000, metadata={"least": 1})

    @override
    def check(self, space: SearchSpace) -> None:
        if self.bounds == "enforce" or space.size == 1:
            return
        bounded = np.flatnonzero(np.isfinite(space.lower) | np.isfinite(space.upper))
        if len(bounded):
            p = space.unknowns[bounded[0]].parameter
            raise ProblemError(
                f"{dotted('parameters', p.name)}.bounds: are [{p.lower:g}, {p.upper:g}], but "
                'method "nelder_mead" does not enforce bounds by default; remove the bounds, set '
                'method.options.bounds = "enforce", or use method "pattern_search"'
            )

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        (at,) = yield Points(space.start[None, :], "start", Progress(0, np.nan))
        if not np.isfinite(at.rank[1]):
            reason = at.reason or "the cost has no value at the start"
            return Solution(space.start, np.nan, Ending.START_FAILED, reason)
        if space.size == 1:
            limits = self.initial_step, self.xtol, self.max_iterations
            return (yield from search_in_thread(_LineSearch(space, at, *limits).solve))
        return (yield from _SimplexSearch(space, self, at).steps())


VertexRequests = Generator[Points, list[Evaluation], list[SimplexVertex]]


class _SimplexSearch:
    """State of a search: the simplex, best vertex first, and the coefficients of its moves."""

    def __init__(self, space: SearchSpace, options: NelderMead, start: Evaluation) -> None:
        self._coordinates, self._options = ScaledCoordinates(space), options
        adaptive = options.coefficients == "adaptive"
        self._moves = VertexMoves.adaptive(space.size) if adaptive else VertexMoves()
        self._parallel = max(1, min(options.parallel, space.size // 2))
        self._simplex = [SimplexVertex(np.zeros(space.size), start)]
        self._least_spread = options.ftol**2 * abs(start.cost)
        self._progress = Progress(0, start.cost, damping=options.initial_step)

    def steps(self) -> Search:
        options = self._options
        first = corners(self._coordinates, self._simplex[0].u, options.initial_step)
        self._simplex = ordered(self._simplex + (yield from self._ask(first, "simplex")))
        ending, restarts = None, 0
        while ending is None:
            if self._converged():
                improved = options.max_restarts > 0 and (yield from self._restart())
                restarts += 1
                if not improved:
                    ending = Ending.CONVERGED
                elif restarts > options.max_restarts:
                    ending = Ending.STALLED
            elif self._progress.iteration >= options.max_iterations:
                ending = Ending.MAX_ITERATIONS
            else:
                before = self._simplex[0]
                yield from self._iterate()
                self._advance(before)
        best = self._simplex[0]
        x, iterations = self._coordinates.x(best.u), self._progress.iteration
        message = COLLAPSES if ending is Ending.STALLED else ""
        return Solution(x, best.cost, ending, message, iterations, at=best.at)

    def _advance(self, before: SimplexVertex) -> None:
        best = self._simplex[0]
        self._progress = Progress(
            self._progress.iteration + 1,
            best.cost,
            step=float(np.abs(best.u - before.u).max()),
            damping=diameter(self._simplex),
        )

    def _ask(self, u: FloatArray, purpose: str) -> VertexRequests:
        evaluations = yield Points(self._coordinates.x(u), purpose, self._progress)
        return [SimplexVertex(*pair) for pair in zip(u, evaluations, strict=True)]

    @property
    def _tolerance(self) -> float:
        """Largest difference of costs that counts as zero."""
        return self._options.ftol * abs(self._simplex[0].cost) + self._least_spread

    def _converged(self) -> bool:
        size = diameter(self._simplex)
        if size > self._options.xtol:
            return size == 0.0
        return (
            spread(self._simplex) <= self._tolerance
            or size <= NEGLIGIBLE_SIMPLEX * self._options.xtol
        )

    def _iterate(self) -> Generator[Points, list[Evaluation], None]:
        """Move the worst vertices along the lines through the centre of the others, or shrink."""
        fixed, moving = self._simplex[: -self._parallel], self._simplex[-self._parallel :]
        moved = yield from self._follow_paths(fixed, moving)
        if all(new is old for new, old in zip(moved, moving, strict=True)):
            best, *others = self._simplex
            closer = np.array([best.u + self._moves.shrink * (v.u - best.u) for v in others])
            fixed, moved = [best], (yield from self._ask(closer, "shrink"))
        self._simplex = ordered(fixed + moved)

    def _follow_paths(
        self, fixed: list[SimplexVertex], moving: list[SimplexVertex]
    ) -> VertexRequests:
        """Return the final vertices of the paths of the moving vertices."""
        centre = np.add.reduce([v.u for v in fixed]) / len(fixed)
        paths = [self._moves.path(v, fixed) for v in moving]
        ends = list(moving)
        evaluated: dict[tuple[int, float], SimplexVertex] = {}
        wanted = {i: next(path) for i, path in enumerate(paths)}
        speculative = self._moves.along if self._options.speculative else ()
        while wanted:
            trials = [*wanted.items(), *((i, m) for i in wanted for m in speculative)]
            new_trials = [trial for trial in dict.fromkeys(trials) if trial not in evaluated]
            if new_trials:
                u = np.array([centre + m * (moving[i].u - centre) for i, m in new_trials])
                asked = yield from self._ask(self._coordinates.clip(u), "trial")
                evaluated |= zip(new_trials, asked, strict=True)
            further: dict[int, float] = {}
            for i, move in wanted.items():
                try:
                    further[i] = paths[i].send(evaluated[i, move])
                except StopIteration as end:
                    ends[i] = end.value
            wanted = further
        return ends

    def _restart(self) -> Generator[Points, list[Evaluation], bool]:
        """Poll around the best vertex and build a new simplex; return whether the cost fell."""
        best = self._simplex[0]
        step = np.sqrt(max(self._options.xtol, NEGLIGIBLE_SIMPLEX**2))
        points = axis_points(self._coordinates, best.u, step).reshape(-1, len(best.u))
        evaluated = yield from self._ask(points, "poll")
        pairs = zip(evaluated[::2], evaluated[1::2], strict=True)
        # a step of zero at a bound would make the simplex degenerate
        best_of_pairs = [
            min(pair, key=lambda v: (not np.any(v.u != best.u), v.cost)) for pair in pairs
        ]
        tolerance = self._tolerance
        self._simplex = ordered([best, *best_of_pairs])
        return best.cost - self._simplex[0].cost > tolerance
