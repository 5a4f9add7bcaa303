"""Linear time-varying systems, integrated for many forcings at once.

    d(dx)/dt = A dx + f,    dy = C dx

f is linear between the times of the grid, and A constant within each step: the mean of its values
at both ends. Symbols are those of the references in `discrete_time.py` and `step_matrices.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from cluster_est.closed_loop.candidates.step_matrices import propagate, run_recursion
from cluster_est.closed_loop.screening.discrete_time import discretise, streamed_steps
from workers.messages import FloatArray, IntArray, Linearisation

LARGE = 24
"""States from which the matrices of all steps take too much memory, and a library's products of
matrices are faster than loops."""

FEW_VALUES, MANY_VALUES = 2_000_000, 12_000_000
"""Values that are kept at once: 16 MB, and 96 MB where few blocks save making the steps again."""


@dataclass(frozen=True)
class Forcing:
    """Forcings of a linear system, each an amount along a direction among its states.

    Attributes
    ----------
    amounts : (n, m)
        Of m forcings.
    directions
        A state, by its index, or a direction that changes with time, (n, x).
    which : (m,)
        The direction of each forcing.
    """

    amounts: FloatArray = field(repr=False)
    directions: Sequence[int | FloatArray] = field(repr=False)
    which: IntArray


class LinearSystem(ABC):
    """A linear time-varying system along one experiment."""

    block: int
    """The most forcings for one call of `respond`."""

    @abstractmethod
    def respond(self, forcing: Forcing) -> FloatArray:
        """(n, y, m): the outputs' response to each forcing, from rest."""

    @abstractmethod
    def weigh(self, source: FloatArray) -> FloatArray:
        """Integrate the adjoint backwards: what a forcing at any state weighs with.

        Parameters
        ----------
        source : (n, x, m)
            m weightings of the states; it may be overwritten.

        Returns
        -------
        (n, x, m)
        """


def linear_system(linear: Linearisation) -> LinearSystem:
    """Make a linear system ready to be integrated, by the way that suits its size."""
    if linear.A.shape[1] < LARGE:
        return SmallSystem(linear)
    return LargeSystem(linear)


@final
class SmallSystem(LinearSystem):
    """A system of few states: the matrices of all steps at once, and loops of the core."""

    def __init__(self, linear: Linearisation) -> None:
        n, outputs, states = linear.C.shape
        self._linear = linear
        self._steps = discretise(linear)
        self.block = max(1, FEW_VALUES // max(1, n * max(outputs, states)))

    def respond(self, forcing: Forcing) -> FloatArray:
        n, m = forcing.amounts.shape
        forced = np.zeros((n, self._linear.A.shape[1], m))
        for k, direction in enumerate(forcing.directions):
            own = forcing.which == k
            amounts = forcing.amounts[:, own]
            if isinstance(direction, np.ndarray):
                forced[:, :, own] += direction[:, :, None] * amounts[:, None, :]
            else:
                forced[:, direction, own] += amounts
        return np.asarray(np.matmul(self._linear.C, propagate(self._steps, forced)))

    def weigh(self, source: FloatArray) -> FloatArray:
        return run_recursion("core_run_adjoint", self._steps, source)


@final
class LargeSystem(LinearSystem):
    """A system of many states: the matrices of one step at a time.

    A forcing along a state needs one column of these, so that the only product of whole matrices
    is the one with the states.
    """

    def __init__(self, linear: Linearisation) -> None:
        n, outputs, _ = linear.C.shape
        self._linear = linear
        self.block = max(1, MANY_VALUES // max(1, n * outputs))

    def respond(self, forcing: Forcing) -> FloatArray:
        n, m = forcing.amounts.shape
        shown = self._linear.C
        found = np.zeros((n, shown.shape[1], m))
        dx = np.zeros((shown.shape[2], m))
        first, last = np.zeros((2, len(forcing.directions), m))
        places = forcing.which, np.arange(m)
        last[places] = forcing.amounts[0]
        for k, step in enumerate(streamed_steps(self._linear)):
            first, last = last, first
            last[places] = forcing.amounts[k + 1]
            dx = step.keep @ dx
            dx += _along(step.from_first, forcing.directions, k) @ first
            dx += _along(step.from_last, forcing.directions, k + 1) @ last
            found[k + 1] = shown[k + 1] @ dx
        return found

    def weigh(self, source: FloatArray) -> FloatArray:
        found = np.zeros_like(source)
        now = source[-1]
        last = len(source) - 1
        for k, step in zip(
            range(last - 1, -1, -1), streamed_steps(self._linear, backwards=True), strict=True
        ):
            found[k] += step.from_first.T @ now
            found[k + 1] += step.from_last.T @ now
            now = step.keep.T @ now + source[k]
        return found


def _along(matrix: FloatArray, directions: Sequence[int | FloatArray], time: int) -> FloatArray:
    """(x, directions): a matrix times each direction at one of the times."""
    columns = [
        matrix @ direction[time] if isinstance(direction, np.ndarray) else matrix[:, direction]
        for direction in directions
    ]
    return np.column_stack(columns)
