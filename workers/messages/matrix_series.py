"""Matrices along time with one pattern of entries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from workers.messages.equality import by_content
from workers.messages.types import FloatArray, IntArray


@by_content
@dataclass(frozen=True, slots=True)
class MatrixSeries:
    """A matrix at each of n times; entries that are 0 at all of them are not kept.

    In a model of many states each acts on few others. `numpy.asarray` gives all entries.

    Attributes
    ----------
    shape
        (n, rows, columns).
    rows, columns : (k,)
        Of the entries that are kept, ascending by row, then by column.
    values : (n, k)
        Of those entries.
    """

    shape: tuple[int, int, int]
    rows: IntArray
    columns: IntArray
    values: FloatArray

    @classmethod
    def of(cls, matrices: FloatArray) -> Self:
        """From all entries, (n, rows, columns)."""
        rows, columns = np.nonzero((matrices != 0.0).any(axis=0))
        n, height, width = matrices.shape
        return cls((n, height, width), rows, columns, matrices[:, rows, columns])

    def at(self, time: int) -> FloatArray:
        """(rows, columns): all entries at one of the times."""
        return self._filled(self.values[time])

    def largest(self) -> FloatArray:
        """(rows, columns): the largest absolute value of each entry."""
        return self._filled(np.abs(self.values).max(axis=0))

    def row(self, row: int) -> FloatArray:
        """(n, columns): one row at all times."""
        found = np.zeros((self.shape[0], self.shape[2]))
        own = self.rows == row
        found[:, self.columns[own]] = self.values[:, own]
        return found

    def _filled(self, values: FloatArray) -> FloatArray:
        found = np.zeros(self.shape[1:])
        found[self.rows, self.columns] = values
        return found

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[np.float64]:
        """All entries; numpy calls this."""
        if copy is False:
            raise ValueError("entries that are not kept can only be copied")
        found = np.zeros(self.shape)
        found[:, self.rows, self.columns] = self.values
        return found if dtype is None else found.astype(dtype)
