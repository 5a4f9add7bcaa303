"""The names of a result's tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Self

import pyarrow as pa


class TableNames(tuple[str, ...]):
    """Names of a result's tables; called, it makes all of them.

    So `result.tables` names them, and `result.tables()` gives them.

    Parameters
    ----------
    names
        In the order in which they are shown.
    make
        Makes a table of its name.
    """

    _make: Callable[[str], pa.Table]

    def __new__(cls, names: Iterable[str], make: Callable[[str], pa.Table]) -> Self:
        """Keep how tables are made beside their names."""
        made = super().__new__(cls, names)
        made._make = make
        return made

    def __call__(self) -> dict[str, pa.Table]:
        """Make every table, by its name."""
        return {name: self._make(name) for name in self}
