"""SymPy equations as compiled C-callable functions.

LLVM's own language is the quick way (`machine_code`); numba takes what that does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import sympy as sp
from numba import carray, cfunc
from numba.core import types
from sympy.printing.pycode import pycode

from workers.effects.machine_code import Assembly, MachineCode, UntranslatableError, assemble


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
    MachineCode or numba cfunc
        Its `address` is what compiled loops call. Keep it: the code lives as long as the object.
    """
    try:
        return _assembled(arrays, locations, assignments, time)
    except UntranslatableError:
        return _translated(arrays, locations, assignments, time)


def _assembled(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    assignments: Sequence[CAssignment],
    time: sp.Symbol,
) -> MachineCode:
    body = Assembly()
    prepared = _prepared(assignments, time)
    body.define(_TIME, "%t")
    for local, symbol in prepared.read:
        body.define(local, body.load(*locations[symbol]))
    for symbol, value in prepared.common:
        body.define(symbol, body.write(value))
    results = [body.write(value) for value in prepared.values]
    for assignment, result in zip(assignments, results, strict=True):
        if assignment.add:
            result = body.add(body.load(assignment.target, assignment.index), result)
        body.store(assignment.target, assignment.index, result)
    return assemble(arrays, body)


def _translated(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    assignments: Sequence[CAssignment],
    time: sp.Symbol,
) -> Any:
    text = _source(arrays, locations, assignments, time)
    scope: dict[str, Any] = {"carray": carray, "math": __import__("math")}
    exec(compile(text, "<effect>", "exec"), scope)  # printed by SymPy from a checked syntax tree
    pointers = [types.CPointer(types.float64)] * len(arrays)  # type: ignore[attr-defined]
    return cfunc(types.int32(types.float64, *pointers), error_model="numpy")(scope["effect"])


_TIME = sp.Symbol("t", real=True)


@dataclass(frozen=True)
class _PreparedEquations:
    """Equations over symbols of short names, by which sums and products are ordered.

    Attributes
    ----------
    read
        (short, original) of each symbol but the time.
    common
        Parts that are computed once, in this order.
    values
        The equations, with the symbols of these parts in them.
    """

    read: tuple[tuple[sp.Symbol, sp.Symbol], ...]
    common: tuple[tuple[sp.Symbol, sp.Expr], ...]
    values: tuple[sp.Expr, ...]


def _prepared(assignments: Sequence[CAssignment], time: sp.Symbol) -> _PreparedEquations:
    used = set().union(*(a.value.free_symbols for a in assignments)) if assignments else set()
    ordered = sorted(used - {time}, key=str)
    read = tuple((sp.Symbol(f"s{i}", real=True), symbol) for i, symbol in enumerate(ordered))
    short = {symbol: local for local, symbol in read} | {time: _TIME}
    values = [a.value.xreplace(short) for a in assignments]
    common, reduced = sp.cse(values, symbols=sp.numbered_symbols("c"))
    return _PreparedEquations(read, tuple(common), tuple(reduced))


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
    prepared = _prepared(assignments, time)
    lines = [f"{name} = carray({name}_, {size})" for name, size in sizes.items()]
    for local, symbol in prepared.read:
        array, index = locations[symbol]
        lines.append(f"{local} = {array}[{index}]")
    lines += [f"{symbol} = {_print(value)}" for symbol, value in prepared.common]
    lines += [f"r{i} = {_print(value)}" for i, value in enumerate(prepared.values)]
    for i, assignment in enumerate(assignments):
        lines.append(
            f"{assignment.target}[{assignment.index}] {'+=' if assignment.add else '='} r{i}"
        )
    header = ", ".join(f"{name}_" for name in arrays)
    return "\n    ".join([f"def effect(t, {header}):", *lines, "return 0"]) + "\n"


def _print(value: sp.Expr) -> str:
    """Return the Python text of an expression, a power of a half as a square root."""
    return str(pycode(value, fully_qualified_modules=True))
