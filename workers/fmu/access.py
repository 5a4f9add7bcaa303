"""Access to variables of an FMU by rows of numbers, see `workers.kernels.fmi.values`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from workers.fmu.variable import ModelVariable
from workers.kernels.fmi.values import TYPES, VariableAccess

_CALLED = {"Enumeration": "Int64"}
"""Types whose values are got and set as those of another one."""


def variable_access(
    variables: Sequence[ModelVariable | None],
    array_starts: Callable[[ModelVariable], Sequence[float]],
) -> VariableAccess:
    """Assign the columns of a row of numbers to variables of the FMU.

    Parameters
    ----------
    variables
        Those of the columns; None for a column that the FMU does not see.
    array_starts
        The values of all elements of an array, for those that have no column.
    """
    n_reals = 0
    for variable in variables:
        if variable is None or variable.type != "Float64" or variable.size > 1:
            break
        n_reals += 1
    others: list[_ArrayAccess] = []
    for column, variable in enumerate(variables[n_reals:], n_reals):
        if variable is not None:
            _assign_column(variable, column, others)
    elements = [
        (each.code, each.variable.reference, len(each.columns), column, int(bits))
        for each in others
        for column, bits in zip(
            each.columns,
            np.array(array_starts(each.variable), np.float64).view(np.int64),
            strict=True,
        )
    ]
    return VariableAccess(
        reals=np.array([v.reference for v in variables[:n_reals] if v is not None], np.uint32),
        elements=np.array(elements, np.int64).reshape(-1, 5),
    )


@dataclass(frozen=True)
class _ArrayAccess:
    """A variable that has a call of its own, and the column of each of its elements, or -1."""

    code: int
    variable: ModelVariable
    columns: list[int]


def _assign_column(variable: ModelVariable, column: int, others: list[_ArrayAccess]) -> None:
    """Assign a column to an element of a variable; a second name of a value has its own call."""
    code = TYPES.index(_CALLED.get(variable.type, variable.type))
    for each in others:
        same = each.code == code and each.variable.reference == variable.reference
        if same and each.columns[variable.element] < 0:
            each.columns[variable.element] = column
            return
    columns = [-1] * variable.size
    columns[variable.element] = column
    others.append(_ArrayAccess(code, variable, columns))
