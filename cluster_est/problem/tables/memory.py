"""Tables in memory: of pandas, polars or pyarrow, or a dict of columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import MeasuredTable, named_columns, read_table, repeated
from workers.messages import FloatArray


def table_of(given: Any, where: str) -> MeasuredTable:
    """A table in memory as a measured table.

    Parameters
    ----------
    given
        A DataFrame of pandas or polars, a table of pyarrow, a dict of columns, or a path.
    where
        Opens each message.

    Raises
    ------
    DataError
        If it is none of these.
    """
    if isinstance(given, MeasuredTable):
        return given
    if isinstance(given, Path):
        return read_table(given, where)
    if hasattr(given, "items"):
        pairs = [(str(name), column) for name, column in given.items()]
        index: Any = getattr(given, "index", None)
        if getattr(index, "name", None) is not None:  # of pandas
            pairs.insert(0, (str(index.name), index.to_series()))
        return _from_columns(pairs)
    if hasattr(given, "__arrow_c_stream__") or isinstance(given, pa.RecordBatch):
        return named_columns("the table", pa.table(given))
    raise DataError(
        f"{where}: the table must be of pandas, polars or pyarrow, a dict of columns or a path but "
        f"is {type(given).__name__!r}; convert it"
    )


def _from_columns(pairs: Sequence[tuple[str, Any]]) -> MeasuredTable:
    """Columns of pandas or of a dict; one that Arrow cannot read is unusable, not an error yet."""
    counts = Counter(name for name, _ in pairs)
    columns: dict[str, pa.ChunkedArray | FloatArray] = {}
    unusable = {name: repeated(count) for name, count in counts.items() if count > 1}
    for name, column in pairs:
        if name in unusable:
            continue
        try:
            columns[name] = pa.chunked_array([pa.array(column, from_pandas=True)])
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            unusable[name] = f"must hold numbers but cannot be read ({reason})"
    return MeasuredTable("the table", columns, unusable)
