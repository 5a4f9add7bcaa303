"""Derivatives of the residuals by finite differences, one point for each colour of unknowns.

The error of a forward difference is the sum of the noise divided by the step and the curvature
times the step. The best relative step is the square root of the relative noise, and the cube root
for a central difference (P. E. Gill, W. Murray, M. H. Wright, Practical Optimization (1981),
section 8.6). The noise of a simulation is larger than the rounding of a double. The result of an
adaptive solver jumps by a part of its tolerance whenever its number of steps changes.

If a simulation fails, its unknowns are evaluated again on the other side and with other steps. An
unknown without a derivative is frozen at this point. `without_guesses` changes the ending of a
search that ends with frozen unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import Literal

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.method import Ending, Evaluation, Points, Progress, Solution
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, IntArray, Outcome, Solver

Scheme = Literal["forward", "central"]
Differences = Literal["auto", "forward", "central", "sensitivities"]
"""Values of the option `differences`."""
LARGE_JACOBIAN = 2**23
"""Number of entries above which a solution may store its Jacobian in blocks."""
NOISE_OF_TOLERANCE = 1e-3
"""Noise of an adaptive solver's result, as a part of its tolerance."""
NOISE_OF_CVODE = 10.0
"""Noise of CVODE's result, as a multiple of its tolerance.

CVODE changes its order and step abruptly. The multiple is 1 to 100 on stiff models."""
NOISE_FIXED = 1e-14
"""Relative noise of a solver with fixed steps, and lower limit for other solvers."""
NOISE_UNKNOWN = 1e-11
"""Relative noise of a co-simulation FMU, whose solver is unknown."""
STEP_PARTS: dict[Scheme, tuple[tuple[float, ...], ...]] = {
    "forward": ((1.0,), (-1.0, 0.5), (-0.5, 2.0), (-2.0, 0.25)),
    "central": ((1.0, -1.0), (0.5, -0.5), (2.0, -2.0), (0.25, -0.25)),
}
"""Parts of a step in each request, until each derivative is known."""
STEP_REDUCTION = 0.9
"""Factor of the steps after all parts of `STEP_PARTS` have failed."""
MOST_NAMED_UNKNOWNS = 6
"""Largest number of unknowns named in a message."""


@dataclass(frozen=True)
class ResidualJacobian:
    """The Jacobian of the residuals and of the constraints at a point.

    Attributes
    ----------
    blocks
        Jacobian of the residuals, (residuals, unknowns); zero in the columns of frozen unknowns.
    frozen : (unknowns,)
        Unknowns whose derivative could not be computed because a simulation failed.
    steps : (unknowns,)
        Difference step of each unknown.
    constraint_jacobian : (constraints, unknowns)
        Derivatives of `Evaluation.constraints`; zero in frozen columns too.
    walls : (unknowns,)
        1 if all simulations above the point failed but one below succeeded; -1 for the reverse; 0
        otherwise. Empty if the first request gave all derivatives.
    """

    blocks: BlockMatrix
    frozen: npt.NDArray[np.bool_]
    steps: FloatArray
    constraint_jacobian: FloatArray
    walls: FloatArray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def matrix(self) -> FloatArray:
        """Jacobian of the residuals as one array (residuals, unknowns)."""
        return self.blocks.dense()

    @property
    def dense_if_small(self) -> FloatArray | None:
        """`matrix`; None if it is too large for `Solution.jacobian`."""
        return None if self.blocks_if_large is not None else self.matrix

    @property
    def blocks_if_large(self) -> BlockMatrix | None:
        """`blocks` if the whole matrix is too large, else None."""
        entries = self.blocks.row_count * self.blocks.size
        return self.blocks if self.blocks.sparse and entries > LARGE_JACOBIAN else None

    def added_to(self, solution: Solution, space: SearchSpace, *, dense: bool = False) -> Solution:
        """Return a solution with these derivatives, as one array if small or if `dense`."""
        large = None if dense else self.blocks_if_large
        found = replace(
            solution,
            jacobian=self.matrix if large is None else None,
            block_jacobian=large,
            difference_steps=self.steps,
            frozen=self.frozen,
        )
        return without_guesses(space, found, self.frozen)


def without_guesses(
    space: SearchSpace, solution: Solution, frozen: npt.NDArray[np.bool_]
) -> Solution:
    """Return a solution that does not count as converged if unknowns have no derivatives.

    Parameters
    ----------
    space, solution
        The space, and the solution of a search in it.
    frozen : (unknowns,)
        True for unknowns without derivatives at the end of the search.
    """
    if not frozen.any() or solution.ending not in (Ending.CONVERGED, Ending.NO_EFFECT):
        return solution
    names = [repr(space.unknowns[i].label) for i in np.flatnonzero(frozen)]
    shown = ", ".join(names[:MOST_NAMED_UNKNOWNS])
    more = (
        f" and {len(names) - MOST_NAMED_UNKNOWNS} others"
        if len(names) > MOST_NAMED_UNKNOWNS
        else ""
    )
    message = (
        f"{Ending.DERIVATIVES_MISSING}: simulations close to the last point failed for "
        f"{shown}{more}"
    )
    return replace(solution, ending=Ending.DERIVATIVES_MISSING, message=message)


def relative_noise(solver: Solver) -> float:
    """Return the noise of a simulation relative to its result."""
    if solver.name == "rk4":
        return NOISE_FIXED
    if solver.name == "cvode":
        return max(NOISE_FIXED, NOISE_OF_CVODE * (solver.rtol or 1e-8))
    if solver.name == "dormand_prince":
        return max(NOISE_FIXED, NOISE_OF_TOLERANCE * (solver.rtol or 1e-8))
    return max(NOISE_UNKNOWN, NOISE_OF_TOLERANCE * (solver.rtol or 0.0))


def suitable_step(space: SearchSpace, scheme: Scheme) -> float:
    """Return the relative step that suits the noise of the solver."""
    noise = relative_noise(space.problem.model.solver)
    return float(noise ** (0.5 if scheme == "forward" else 1.0 / 3.0))


def difference_steps(
    space: SearchSpace, x: FloatArray, scheme: Scheme, relative: float
) -> FloatArray:
    """Return a step for each unknown, with the sign that keeps forward differences within bounds.

    A relative step of 0 selects the step from the simulation's noise.
    """
    if relative <= 0.0:
        relative = suitable_step(space, scheme)
    size = np.where(space.logarithmic, 1.0, np.maximum(np.abs(x), space.typical))
    distance = np.maximum(space.upper - x, x - space.lower)
    steps = np.minimum(relative * size, 0.5 * distance)
    steps = (x + steps) - x
    return np.where(x + steps > space.upper, -steps, steps)


def jacobian(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
) -> Generator[Points, list[Evaluation], ResidualJacobian]:
    """Request the points of a Jacobian and assemble it.

    Parameters
    ----------
    space, x, at
        The space, the point and its evaluation.
    scheme
        "forward" costs one evaluation for each colour, "central" two.
    relative_step
        Relative step; 0 selects the step from the noise of the solver.
    """
    steps = difference_steps(space, x, scheme, relative_step)
    beside = Neighbours(x, scheme, space.colours)
    purpose = "jacobian" if scheme == "forward" else "jacobian_central"
    wanted = np.ones(space.size, dtype=bool)
    for parts in STEP_PARTS[scheme]:
        yield from beside.ask(space, steps, parts, wanted, purpose, progress)
        found = _assemble(space, at, steps, beside)
        wanted = found.frozen
        if not wanted.any():
            break
    return found


class Neighbours:
    """Evaluations at neighbours of a point, in rounds of requests.

    Parameters
    ----------
    x, scheme
        The point, and the scheme of the differences.
    groups
        Groups of unknowns that move together in one point.
    """

    def __init__(self, x: FloatArray, scheme: Scheme, groups: Sequence[IntArray]) -> None:
        self.x, self._scheme, self._groups = x, scheme, groups
        self._group_of = np.zeros(len(x), np.intp)
        for group, members in enumerate(groups):
            self._group_of[members] = group
        self._rounds: list[dict[int, tuple[FloatArray, Evaluation]]] = []

    def ask(
        self,
        space: SearchSpace,
        steps: FloatArray,
        parts: tuple[float, ...],
        wanted: npt.NDArray[np.bool_],
        purpose: str,
        progress: Progress | None,
    ) -> Generator[Points, list[Evaluation], None]:
        """Evaluate, in one request, points at parts of the steps of the `wanted` unknowns."""
        chosen = [g for g, members in enumerate(self._groups) if wanted[members].any()]
        points = np.tile(self.x, (len(parts), len(chosen), 1))
        for place, part in zip(points, parts, strict=True):
            for row, group in zip(place, chosen, strict=True):
                members = self._groups[group][wanted[self._groups[group]]]
                row[members] += part * steps[members]
        points = np.clip(points, space.lower, space.upper)
        answers = yield Points(points.reshape(-1, len(self.x)), purpose, progress)
        for k, place in enumerate(points):
            own = answers[k * len(chosen) : (k + 1) * len(chosen)]
            self._rounds.append(dict(zip(chosen, zip(place, own, strict=True), strict=True)))

    @property
    def walls(self) -> FloatArray:
        """See `ResidualJacobian.walls`."""
        if len(self._rounds) <= len(STEP_PARTS[self._scheme][0]):
            return np.zeros(0)
        tried = np.zeros((2, 2, len(self.x)), dtype=bool)  # failed or succeeded, below or above
        for group, (point, evaluation) in chain(*(each.items() for each in self._rounds)):
            members = self._groups[group]
            for side, moved in enumerate((point < self.x, point > self.x)):
                tried[int(evaluation.ok), side, members] |= moved[members]
        (fails_below, fails_above), (works_below, works_above) = tried
        above = fails_above & ~works_above & works_below
        below = fails_below & ~works_below & works_above
        return np.asarray(above.astype(np.float64) - below)

    def derivative(
        self, i: int, at: FloatArray, value: Callable[[Evaluation], FloatArray | None]
    ) -> FloatArray | None:
        """Return the derivative of a value by an unknown; None if too few neighbours have one.

        Parameters
        ----------
        i
            Index of the unknown.
        at, value
            The value at the point, and the function that returns the value of an evaluation. It
            returns None if the value is undefined.
        """
        group = int(self._group_of[i])
        asked = [each[group] for each in self._rounds if group in each]
        samples = [(float(point[i]), value(evaluation)) for point, evaluation in asked]
        if self._scheme == "central":
            for (p, ahead), (q, behind) in zip(samples[::2], samples[1::2], strict=True):
                if ahead is not None and behind is not None and p != q:
                    return np.asarray((ahead - behind) / (p - q))
        x = float(self.x[i])
        known = {p - x: found for p, found in samples if found is not None and p != x}
        if self._scheme == "forward":
            return next(((found - at) / h for h, found in known.items()), None)
        return _slope_of_parabola(at, *list(known.items())[:2]) if len(known) > 1 else None


def _slope_of_parabola(
    at: FloatArray, one: tuple[float, FloatArray], other: tuple[float, FloatArray]
) -> FloatArray:
    """Return the slope at a point to second order, from values at two distances from it."""
    (h, first), (k, second) = one, other
    return np.asarray(((first - at) * (k / h) - (second - at) * (h / k)) / (k - h))


def _assemble(
    space: SearchSpace, at: Evaluation, steps: FloatArray, beside: Neighbours
) -> ResidualJacobian:
    """Return the Jacobian from the evaluated neighbours; freeze unknowns without a derivative."""
    pairs = zip(at.rows, space.acting, strict=True)
    blocks = [np.zeros((row.stop - row.start, len(columns))) for row, columns in pairs]
    constraints = np.zeros((len(space.constraint_names), space.size))
    on_parameters = space.parameter_constraint_jacobian(beside.x)
    constraints[: len(on_parameters)] = on_parameters
    frozen = np.zeros(space.size, dtype=bool)
    for e, columns in enumerate(space.acting):
        here = _values(at.outcomes[e])

        def value(each: Evaluation, e: int = e) -> FloatArray | None:
            return _values(each.outcomes[e])

        for j, i in enumerate(columns.tolist()):
            found = None if here is None else beside.derivative(i, here, value)
            if found is None:
                frozen[i] = True
                continue
            count = len(blocks[e])
            blocks[e][:, j] = found[:count]
            constraints[space.constraint_rows[e], i] = found[count:]
    for block, columns in zip(blocks, space.acting, strict=True):
        block[:, frozen[columns]] = 0.0
    constraints[:, frozen] = 0.0
    return ResidualJacobian(
        BlockMatrix(tuple(blocks), space.acting, space.size),
        frozen,
        steps,
        constraints,
        beside.walls,
    )


def _values(outcome: Outcome) -> FloatArray | None:
    """Return the residuals and then the constraints; None if the values are undefined."""
    if outcome.residuals is None or not len(outcome.constraints):
        return outcome.residuals
    if not np.isfinite(outcome.constraints).all():
        return None
    return np.concatenate([outcome.residuals, outcome.constraints])
