"""Replaces ordered words, such as low, medium and high, by their positions in the order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.problem.tables.cells import is_text, trimmed_cells
from cluster_est.problem.tables.measured import MeasuredColumns
from workers.fmu.description import nearest


def with_grades(
    columns: MeasuredColumns, variable: str, column: str, grades: Sequence[str]
) -> MeasuredColumns:
    """Replace the words in a column by their positions among the grades, which count from 1.

    Parameters
    ----------
    columns
        Columns of the experiment's table.
    variable, column
        The measured output, and its column.
    grades
        All words, the lowest first.

    Raises
    ------
    DataError
        If a grade is given twice, a word is not a grade, or the column has no words.
    """
    table, where = columns.table, f"{columns.where}.outputs.{variable}"
    repeated = [word for word, count in Counter(grades).items() if count > 1]
    if repeated:
        raise DataError(
            f"{where}.ordinal: must name each grade once, but names {repeated[0]!r} several times; "
            "remove one"
        )
    cells = table.columns.get(column)
    if cells is None:
        raise DataError(f"{where}: {table.without(column)}")
    if isinstance(cells, pa.ChunkedArray) and pa.types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    if not isinstance(cells, np.ndarray) and not is_text(cells) and _are_numbers(grades):
        cells = pa.chunked_array([pa.array(_as_words(cells, grades))])
    if isinstance(cells, np.ndarray) or not is_text(cells):
        raise DataError(
            f"{where}.ordinal: {table.path}, column {column!r}: must hold the listed words, but "
            "holds numbers; write ordinal = true"
        )
    words = trimmed_cells(cells).to_pylist()
    places = {word: float(place) for place, word in enumerate(grades, 1)}
    for i, word in enumerate(words):
        if word is not None and word not in places:
            raise DataError(
                f"{where}.ordinal: {table.path}, column {column!r}, row {table.row(i)}: must be "
                f"one of the listed grades, but is {word!r}{nearest(word, grades)}"
            )
    numbers = np.array([np.nan if w is None else places[w] for w in words], np.float64)
    graded = replace(table, columns={**table.columns, column: numbers})
    return replace(columns, table=graded, missing=())  # `missing` is not about positions


def _are_numbers(grades: Sequence[str]) -> bool:
    return all(each.strip().lstrip("+-").replace(".", "", 1).isdigit() for each in grades)


def _as_words(cells: pa.ChunkedArray, grades: Sequence[str]) -> list[str | None]:
    """Return numbers as words: the grades with these values."""
    words = {float(each): each for each in grades}
    return [None if n is None else words.get(float(n), f"{n:g}") for n in cells.to_pylist()]
