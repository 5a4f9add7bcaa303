"""Functions of equations as they stand, which SymPy would try to simplify.

SymPy looks at each pair of arguments of a `Max` for one that is never the larger, and at an `Abs`
for a simpler form of what is in it: it factors their differences, whenever a symbol is replaced. In
an equation with many of them, as a curve has, that takes seconds, and finds nothing where the
arguments are signals. Printers know these by the names of SymPy's.
"""

from __future__ import annotations

from typing import Any, final

import sympy as sp


@final
class Max(sp.Max):  # type: ignore[misc]
    """SymPy's `Max`, simplified only where all arguments are numbers."""

    def __new__(cls, *arguments: Any, evaluate: bool = False) -> sp.Expr:
        if evaluate or _are_numbers(arguments):
            return sp.Max(*arguments)
        return super().__new__(cls, *arguments, evaluate=False)


@final
class Min(sp.Min):  # type: ignore[misc]
    """SymPy's `Min`, likewise."""

    def __new__(cls, *arguments: Any, evaluate: bool = False) -> sp.Expr:
        if evaluate or _are_numbers(arguments):
            return sp.Min(*arguments)
        return super().__new__(cls, *arguments, evaluate=False)


@final
class Abs(sp.Abs):  # type: ignore[misc]
    """SymPy's `Abs`, likewise."""

    @classmethod
    def eval(cls, argument: sp.Expr) -> sp.Expr | None:
        return sp.Abs(argument) if _are_numbers((argument,)) else None


def simplified(equation: sp.Basic) -> sp.Basic:
    """Return an equation with SymPy's own functions, for what looks at its form."""
    if not equation.args:
        return equation
    own = {Max: sp.Max, Min: sp.Min, Abs: sp.Abs}.get(type(equation), equation.func)
    return own(*(simplified(argument) for argument in equation.args))


def _are_numbers(arguments: tuple[Any, ...]) -> bool:
    """Whether all are numbers; refused is what has no size, such as a comparison."""
    terms = [sp.sympify(argument) for argument in arguments]
    for term in terms:
        if not isinstance(term, sp.Expr) or term.is_extended_real is False:
            raise ValueError(f"{term} is no real number")
    return all(term.is_number for term in terms)
