"""Equations as text, read without ever running them as Python.

The text is parsed into Python's syntax tree and only arithmetic, comparisons and the functions
below are turned into SymPy; anything else is refused with a sentence.
"""

from __future__ import annotations

import ast
import threading
from collections.abc import Callable, Mapping
from typing import Any

import sympy as sp

from workers.effects.plain_functions import Abs, Max, Min
from workers.errors import EffectError
from workers.fmu.description import nearest

FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
    "abs": Abs,
    "sign": sp.sign,
    "sqrt": sp.sqrt,
    "exp": sp.exp,
    "log": sp.log,
    "sin": sp.sin,
    "cos": sp.cos,
    "tan": sp.tan,
    "tanh": sp.tanh,
    "atan": sp.atan,
    "min": Min,
    "max": Max,
    "where": lambda condition, yes, no: sp.Piecewise((yes, condition), (no, True)),
}
"""What an equation may call; `where(condition, yes, no)` chooses."""

_ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: _power(a, b),
}
MAX_EXPONENT = 1000
"""Of a number: SymPy would compute all digits of 9^9^9."""
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}
MAX_LENGTH = 2000
_PARSING = threading.Lock()
"""Up to 3.12, CPython counts the depth of a tree for all threads together (its issue 106905)."""


def parse(text: str, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Expr:
    """Read an equation.

    Parameters
    ----------
    text
        Such as "-force * tanh(v / width)"; ``^`` is a power too.
    symbols
        What its names stand for.
    where
        Opens the message if something is wrong.

    Raises
    ------
    EffectError
        If it is no equation, or has a name or function that it may not have.
    """
    if len(text) > MAX_LENGTH:
        raise EffectError(f"{where}: must be at most {MAX_LENGTH} characters but is {len(text)}")
    try:
        with _PARSING:
            tree = ast.parse(text.replace("^", "**").strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        said = getattr(error, "msg", error)
        raise EffectError(f"{where}: must be an equation but {text!r} is not ({said})") from None
    return sp.sympify(_ExpressionReader(symbols, where, text).read(tree.body))


def _power(base: Any, exponent: Any) -> Any:
    if base.is_number and exponent.is_number and abs(exponent) > MAX_EXPONENT:
        raise OverflowError(f"an exponent must be at most {MAX_EXPONENT} but is {exponent}")
    return base**exponent


def _dotted(node: ast.expr) -> str:
    """A name with dots in it, as FMUs have them; empty if it is something else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (before := _dotted(node.value)):
        return f"{before}.{node.attr}"
    return ""


class _ExpressionReader:
    """Walks a syntax tree."""

    def __init__(self, symbols: Mapping[str, sp.Symbol], where: str, text: str) -> None:
        self._symbols, self._where, self._text = symbols, where, text

    def read(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value):
                return sp.Integer(value) if isinstance(value, int) else sp.Float(value, 17)
            case ast.Name(id=name):
                return self._look_up(name, self._symbols, "variable")
            case ast.Attribute() if dotted := _dotted(node):
                return self._look_up(dotted, self._symbols, "variable")
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._compute(lambda value: -value, self.read(operand))
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.read(operand)
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _ARITHMETIC:
                sides = self.read(left), self.read(right)
                return self._compute(_ARITHMETIC[type(operator)], *sides)
            case ast.Compare(left=left, ops=[comparison], comparators=[right]) if (
                type(comparison) in _COMPARISONS
            ):
                return _COMPARISONS[type(comparison)](self.read(left), self.read(right))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, arguments)
        part = ast.get_source_segment(self._text, node) or self._text
        raise EffectError(
            f"{self._where}: must be made of numbers, variables, + - * / ^, comparisons and "
            f"{', '.join(FUNCTIONS)} but has {part!r}"
        )

    def _compute(self, operation: Callable[..., Any], *values: Any) -> Any:
        try:
            return operation(*values)
        except TypeError:
            raise EffectError(
                f"{self._where}: must not compute with a comparison but {self._text!r} does; "
                "where(condition, yes, no) makes a number of it"
            ) from None
        except OverflowError as error:
            raise EffectError(f"{self._where}: {error} in {self._text!r}; lower it") from None

    def _call(self, name: str, arguments: list[ast.expr]) -> Any:
        function = self._look_up(name, FUNCTIONS, "function")
        try:
            return function(*(self.read(argument) for argument in arguments))
        except (TypeError, ValueError) as error:
            raise EffectError(f"{self._where}: {name}(...) cannot be used so ({error})") from None

    def _look_up(self, name: str, known: Mapping[str, Any], what: str) -> Any:
        if name not in known:
            raise EffectError(
                f"{self._where}: {self._text!r} has the unknown {what} {name!r}"
                f"{nearest(name, known)}"
            )
        return known[name]
