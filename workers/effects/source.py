"""SymPy equations as compiled C-callable functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import sympy as sp
from numba import carray, cfunc
from numba.core import types
from sympy.printing.pycode import pycode


class EffectArray(StrEnum):
    """Arrays that equations of effects read and write, by their names in the C of exported FMUs."""

    STATES = "states"
    INPUTS = "raw"
    COEFFICIENTS = "coefficients"
    BASE = "base"
    EFFECTIVE_INPUTS = "edited"
    EFFECTIVE_PARAMETERS = "varied"
    DERIVATIVES = "slopes"
    OUTPUTS = "row"
    RESULT = "result"
    FASTEST = "fastest"


@dataclass(frozen=True)
class CAssignment:
    """`target[index] = value`, or `+=`."""

    target: EffectArray
    index: int
    value: sp.Expr
    add: bool = False


SymbolLocations = dict[sp.Symbol, tuple[EffectArray, int]]
"""(array, index) of each symbol."""


def compile_function(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    assignments: Sequence[CAssignment],
    time: sp.Symbol,
) -> Any:
    """Compile assignments to a C function ``int f(double t, double *a, double *b, ...)``.

    Parameters
    ----------
    arrays
        Names of the pointer arguments, in order.
    locations
        (array, index) of each symbol of the equations.
    assignments
        Statements of the function. All values are read before anything is written.
    time
        The symbol of the first argument.

    Returns
    -------
    numba cfunc
        Its `address` is what compiled loops call. Keep it: the code lives as long as the object.
    """
    text = _source(arrays, locations, assignments, time)
    scope: dict[str, Any] = {"carray": carray, "math": __import__("math")}
    exec(compile(text, "<effect>", "exec"), scope)  # printed by SymPy from a checked syntax tree
    pointers = [types.CPointer(types.float64)] * len(arrays)  # type: ignore[attr-defined]
    return cfunc(types.int32(types.float64, *pointers), error_model="numpy")(scope["effect"])


def _source(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    assignments: Sequence[CAssignment],
    time: sp.Symbol,
) -> str:
    """Return the function as Python text, with common parts computed once."""
    sizes = dict.fromkeys(arrays, 1)
    for array, index in [*locations.values(), *((a.target, a.index) for a in assignments)]:
        sizes[array] = max(sizes[array], index + 1)
    used = set().union(*(a.value.free_symbols for a in assignments)) if assignments else set()
    local_symbols: dict[sp.Symbol, sp.Symbol] = {time: sp.Symbol("t", real=True)}
    lines = [f"{name} = carray({name}_, {size})" for name, size in sizes.items()]
    for number, symbol in enumerate(sorted(used - {time}, key=str)):
        array, index = locations[symbol]
        local_symbols[symbol] = sp.Symbol(f"s{number}", real=True)
        lines.append(f"s{number} = {array}[{index}]")
    values = [a.value.xreplace(local_symbols) for a in assignments]
    common, reduced = sp.cse(values, symbols=sp.numbered_symbols("c"))
    lines += [f"{symbol} = {_print(value)}" for symbol, value in common]
    lines += [f"r{i} = {_print(value)}" for i, value in enumerate(reduced)]
    for i, assignment in enumerate(assignments):
        lines.append(
            f"{assignment.target}[{assignment.index}] {'+=' if assignment.add else '='} r{i}"
        )
    header = ", ".join(f"{name}_" for name in arrays)
    return "\n    ".join([f"def effect(t, {header}):", *lines, "return 0"]) + "\n"


def _print(value: sp.Expr) -> str:
    """Return the Python text of an expression, a power of a half as a square root."""
    return str(pycode(value, fully_qualified_modules=True))
