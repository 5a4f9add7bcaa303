"""Derivatives of the residuals by finite differences, one point for each colour of unknowns.

The error of a forward difference is the sum of the simulation's noise over the step and of the
curvature times the step; it is smallest where the relative step is the square root of the relative
noise, for a central difference the cube root (P. E. Gill, W. Murray, M. H. Wright, Practical
Optimization (1981), section 8.6). The noise of a simulation is not that of a double: an adaptive
solver's result jumps by a part of its tolerance whenever its number of steps changes.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray, Solver

Scheme = Literal["forward", "central"]
Differences = Literal["auto", "forward", "central", "sensitivities"]
"""The choices of a user."""
LARGE = 2**23
"""Entries above which a solution keeps its Jacobian in blocks, where those are much smaller."""
NOISE_OF_TOLERANCE = 1e-3
"""Part of an adaptive solver's tolerance by which its result jumps."""
NOISE_OF_CVODE = 10.0
"""The same of CVODE, which changes order and step in leaps; 1 to 100 on stiff models."""
NOISE_FIXED = 1e-14
NOISE_UNKNOWN = 1e-11
"""Of a co-simulation FMU, whose solver is not known."""


@dataclass(frozen=True)
class ResidualJacobian:
    """The Jacobian of the residuals and of the constraints at a point.

    Attributes
    ----------
    blocks
        Of the residuals, (residuals, unknowns); zero in the columns of frozen unknowns.
    frozen : (unknowns,)
        Unknowns whose derivative could not be computed because a simulation failed.
    steps : (unknowns,)
        The difference step of each unknown.
    constraint_jacobian : (constraints, unknowns)
        Derivatives of `Evaluation.constraints`; zero in frozen columns too.
    """

    blocks: BlockMatrix
    frozen: npt.NDArray[np.bool_]
    steps: FloatArray
    constraint_jacobian: FloatArray

    @cached_property
    def matrix(self) -> FloatArray:
        """The residuals' Jacobian as one array (residuals, unknowns)."""
        return self.blocks.dense()

    @property
    def dense_if_small(self) -> FloatArray | None:
        """`matrix`, unless it is too large for `Solution.jacobian`."""
        return None if self.blocks_if_large is not None else self.matrix

    @property
    def blocks_if_large(self) -> BlockMatrix | None:
        """`blocks`, where the whole matrix is too large."""
        entries = self.blocks.row_count * self.blocks.size
        return self.blocks if self.blocks.sparse and entries > LARGE else None


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

    A relative step of 0 takes the one that suits the simulation's noise.
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
    """Ask for the points of a Jacobian and assemble it.

    Parameters
    ----------
    space, x, at
        The point and its evaluation.
    scheme
        "forward" costs one evaluation for each colour, "central" two.
    relative_step
        0 for the step that suits the solver.
    """
    steps = difference_steps(space, x, scheme, relative_step)
    plus = np.tile(x, (len(space.colours), 1))
    minus = plus.copy()
    for colour, members in enumerate(space.colours):
        plus[colour, members] += steps[members]
        minus[colour, members] -= steps[members]
    if scheme == "forward":
        forward = yield Points(plus, "jacobian", progress)
        quotients = _ColouredDifferences(forward, [at] * len(forward), plus - x)
        return _assemble(space, x, at, steps, quotients)
    minus = np.clip(minus, space.lower, space.upper)
    both = yield Points(np.vstack([plus, minus]), "jacobian_central", progress)
    quotients = _ColouredDifferences(both[: len(plus)], both[len(plus) :], plus - minus)
    return _assemble(space, x, at, steps, quotients)


@dataclass(frozen=True)
class _ColouredDifferences:
    """Two evaluations for each colour, and their distances (colours, unknowns)."""

    plus: list[Evaluation]
    minus: list[Evaluation]
    widths: FloatArray


def _assemble(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    steps: FloatArray,
    quotients: _ColouredDifferences,
) -> ResidualJacobian:
    """Take each unknown's column from the experiments that it acts on, in its colour's point."""
    constraint_rows = space.constraint_rows
    pairs = zip(at.rows, space.acting, strict=True)
    blocks = [np.zeros((row.stop - row.start, len(columns))) for row, columns in pairs]
    constraints = np.zeros((len(space.constraint_names), space.size))
    on_parameters = space.parameter_constraint_jacobian(x)
    constraints[: len(on_parameters)] = on_parameters
    frozen = np.zeros(space.size, dtype=bool)
    colour_of = np.zeros(space.size, np.intp)
    for colour, members in enumerate(space.colours):
        colour_of[members] = colour
    for e, columns in enumerate(space.acting):
        for j, i in enumerate(columns.tolist()):
            colour = colour_of[i]
            plus, minus = quotients.plus[colour].outcomes[e], quotients.minus[colour].outcomes[e]
            width = quotients.widths[colour, i]
            if plus.residuals is None or minus.residuals is None or width == 0.0:
                frozen[i] = True
                continue
            blocks[e][:, j] = (plus.residuals - minus.residuals) / width
            if len(plus.constraints):
                constraints[constraint_rows[e], i] = (plus.constraints - minus.constraints) / width
    for block, columns in zip(blocks, space.acting, strict=True):
        block[:, frozen[columns]] = 0.0
    constraints[:, frozen] = 0.0
    return ResidualJacobian(
        BlockMatrix(tuple(blocks), space.acting, space.size), frozen, steps, constraints
    )
