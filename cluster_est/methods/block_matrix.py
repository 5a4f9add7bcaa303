"""The Jacobian of many experiments, stored as one dense block for each experiment.

The residuals of an experiment depend only on the unknowns that act on it. If each experiment has
unknowns of its own, the whole matrix grows with the square of the number of experiments. The blocks
grow linearly with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from workers.messages import FloatArray, IntArray
from workers.messages.types import by_content

LEAST_SIZE = 200
"""Number of unknowns above which blocks are used."""
LEAST_RATIO = 4
"""Least ratio of the entries of the whole matrix to the entries of the blocks to use blocks."""


@by_content
@dataclass(frozen=True)
class BlockMatrix:
    """A matrix (residuals, unknowns) in one block for each experiment.

    Attributes
    ----------
    blocks
        The block of each experiment: (its residuals, the unknowns that act on it).
    columns
        Indices of the unknowns that act on each experiment, without duplicates.
    size
        Number of unknowns.
    """

    blocks: tuple[FloatArray, ...] = field(repr=False)
    columns: tuple[IntArray, ...] = field(repr=False)
    size: int

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """The rows of each experiment."""
        ends = np.cumsum([0, *(len(block) for block in self.blocks)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def row_count(self) -> int:
        """Number of residuals."""
        return self.rows[-1].stop if self.rows else 0

    @cached_property
    def sparse(self) -> bool:
        """True if blocks save enough memory and work; else use `dense`."""
        entries = sum(block.size for block in self.blocks)
        return self.size > LEAST_SIZE and LEAST_RATIO * entries <= self.row_count * self.size

    @cached_property
    def counts(self) -> IntArray:
        """Number of experiments that each unknown acts on, (unknowns,)."""
        counts = np.zeros(self.size, np.int64)
        for columns in self.columns:
            counts[columns] += 1
        return counts

    @cached_property
    def links(self) -> npt.NDArray[np.bool_]:
        """True for unknowns that act on exactly two consecutive experiments, (unknowns,)."""
        first, last = np.full(self.size, -1), np.full(self.size, -1)
        for e, columns in enumerate(self.columns):
            last[columns] = e
        for e, columns in reversed(list(enumerate(self.columns))):
            first[columns] = e
        return np.asarray((self.counts == 2) & (last - first == 1))

    def norms(self) -> FloatArray:
        """Return the norms (unknowns,) of the columns."""
        squares = np.zeros(self.size)
        for block, columns in zip(self.blocks, self.columns, strict=True):
            squares[columns] += np.add.reduce(block * block, axis=0)
        return np.sqrt(squares)

    def transposed_product(self, values: FloatArray) -> FloatArray:
        """Return J'v (unknowns,), from one value for each residual."""
        result = np.zeros(self.size)
        for block, columns, rows in zip(self.blocks, self.columns, self.rows, strict=True):
            result[columns] += np.add.reduce(block * values[rows, None], axis=0)
        return result

    def product(self, step: FloatArray) -> FloatArray:
        """Return J p (residuals,), from one value for each unknown."""
        result = np.zeros(self.row_count)
        for block, columns, rows in zip(self.blocks, self.columns, self.rows, strict=True):
            result[rows] = block @ step[columns]
        return result

    def scaled_rows(self, factor: FloatArray) -> BlockMatrix:
        """Return the matrix with each row multiplied by a number."""
        pairs = zip(self.blocks, self.rows, strict=True)
        return replace(self, blocks=tuple(factor[rows, None] * block for block, rows in pairs))

    def divided_columns(self, scale: FloatArray) -> BlockMatrix:
        """Return the matrix with each column divided by a number."""
        pairs = zip(self.blocks, self.columns, strict=True)
        return replace(self, blocks=tuple(block / scale[columns] for block, columns in pairs))

    def dense(self) -> FloatArray:
        """Return the whole matrix (residuals, unknowns)."""
        result = np.zeros((self.row_count, self.size))
        for block, columns, rows in zip(self.blocks, self.columns, self.rows, strict=True):
            if np.array_equal(columns, np.arange(self.size)):
                result[rows] = block
            else:
                result[rows, columns] = block
        return result
