"""The Jacobian of many experiments: only what can differ from zero.

The residuals of an experiment depend on the unknowns that act on it, which are few even where each
experiment has unknowns of its own. One dense block for each experiment holds all of that; the whole
matrix would grow with the square of the number of experiments.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from workers.messages import FloatArray, IntArray

MANY = 200
"""Unknowns from which on blocks are worth their trouble."""
SPARSE = 4
"""How many times as large as the blocks the whole matrix must be."""


@dataclass(frozen=True)
class BlockMatrix:
    """A matrix (residuals, unknowns), experiment by experiment.

    Attributes
    ----------
    parts
        For each experiment (its residuals, the unknowns that act on it).
    columns
        For each experiment which unknowns these are, each once.
    size
        Number of unknowns.
    """

    parts: tuple[FloatArray, ...] = field(repr=False)
    columns: tuple[IntArray, ...] = field(repr=False)
    size: int

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """Where each experiment's residuals stand."""
        ends = np.cumsum([0, *(len(part) for part in self.parts)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def height(self) -> int:
        """Number of residuals."""
        return self.rows[-1].stop if self.rows else 0

    @cached_property
    def sparse(self) -> bool:
        """Whether the blocks are worth their trouble; else `dense` is as good and simpler."""
        held = sum(part.size for part in self.parts)
        return self.size > MANY and SPARSE * held <= self.height * self.size

    def norms(self) -> FloatArray:
        """(unknowns,): of the columns."""
        squares = np.zeros(self.size)
        for part, columns in zip(self.parts, self.columns, strict=True):
            squares[columns] += np.add.reduce(part * part, axis=0)
        return np.sqrt(squares)

    def transposed_product(self, values: FloatArray) -> FloatArray:
        """(unknowns,): J'v of one value for each residual."""
        result = np.zeros(self.size)
        for part, columns, rows in zip(self.parts, self.columns, self.rows, strict=True):
            result[columns] += np.add.reduce(part * values[rows, None], axis=0)
        return result

    def product(self, step: FloatArray) -> FloatArray:
        """(residuals,): J p of one value for each unknown."""
        result = np.zeros(self.height)
        for part, columns, rows in zip(self.parts, self.columns, self.rows, strict=True):
            result[rows] = part @ step[columns]
        return result

    def weighted(self, factor: FloatArray) -> BlockMatrix:
        """Each row multiplied with a number."""
        pairs = zip(self.parts, self.rows, strict=True)
        return replace(self, parts=tuple(factor[rows, None] * part for part, rows in pairs))

    def over(self, scale: FloatArray) -> BlockMatrix:
        """Each column divided by a number."""
        pairs = zip(self.parts, self.columns, strict=True)
        return replace(self, parts=tuple(part / scale[columns] for part, columns in pairs))

    def dense(self) -> FloatArray:
        """(residuals, unknowns): the whole matrix."""
        result = np.zeros((self.height, self.size))
        for part, columns, rows in zip(self.parts, self.columns, self.rows, strict=True):
            result[rows, columns] = part
        return result
