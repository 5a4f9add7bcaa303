"""Equations as text, which are parsed but never executed as Python.

The text is parsed into Python's syntax tree. Only arithmetic, comparisons and the functions below
are converted to SymPy; all other syntax is refused with an error message.

Functions such as `Max` and `Abs` are defined here as plain symbolic functions, with the names of
SymPy's functions, because the code printers know these names. SymPy's own functions would be
simplified at every substitution: for each pair of arguments of a `Max`, SymPy tests which is
larger; for an `Abs`, it looks for a simpler argument; and it factors differences. For an equation
with many of them, such as a curve, this takes seconds and finds nothing if the arguments are
signals.
"""

from __future__ import annotations

import ast
import threading
from collections.abc import Callable, Mapping
from typing import Any, final

import sympy as sp

from workers.errors import EffectError
from workers.fmu.description import nearest


@final
class Max(sp.Max):  # type: ignore[misc]
    """SymPy's `Max`, simplified only if all arguments are numbers."""

    def __new__(cls, *arguments: Any, evaluate: bool = False) -> sp.Expr:
        if evaluate or _are_numbers(arguments):
            return sp.Max(*arguments)
        return super().__new__(cls, *arguments, evaluate=False)


@final
class Min(sp.Min):  # type: ignore[misc]
    """SymPy's `Min`, simplified only if all arguments are numbers."""

    def __new__(cls, *arguments: Any, evaluate: bool = False) -> sp.Expr:
        if evaluate or _are_numbers(arguments):
            return sp.Min(*arguments)
        return super().__new__(cls, *arguments, evaluate=False)


@final
class Abs(sp.Abs):  # type: ignore[misc]
    """SymPy's `Abs`, simplified only if its argument is a number."""

    @classmethod
    def eval(cls, argument: sp.Expr) -> sp.Expr | None:
        return sp.Abs(argument) if _are_numbers((argument,)) else None


def simplified(equation: sp.Basic) -> sp.Basic:
    """Return an equation with SymPy's own functions, for code that analyses its structure."""
    if not equation.args:
        return equation
    own = {Max: sp.Max, Min: sp.Min, Abs: sp.Abs}.get(type(equation), equation.func)
    return own(*(simplified(argument) for argument in equation.args))


def _are_numbers(arguments: tuple[Any, ...]) -> bool:
    """Return whether all arguments are numbers.

    Raises
    ------
    ValueError
        If an argument is not real, such as a comparison.
    """
    terms = [sp.sympify(argument) for argument in arguments]
    for term in terms:
        if not isinstance(term, sp.Expr) or term.is_extended_real is False:
            raise ValueError(f"{term} is not a real number")
    return all(term.is_number for term in terms)


EQUATION_FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
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
"""Functions that an equation may call; `where(condition, yes, no)` selects a value."""

_ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: _power(a, b),
}
MAX_EXPONENT = 1000
"""Largest exponent of a number, because SymPy would compute all digits of 9^9^9."""
MOST_DIGITS = 10_000
"""Largest number of digits of a power of numbers, because SymPy computes all of them."""
LARGEST_FUNCTION_VALUE = 1e300
"""Largest value of a function of numbers. The computation of a function of a larger value might
never end."""
MAX_DEPTH = 50
"""Largest depth of nested calls, signs, powers and parentheses, because SymPy handles them by
recursion."""
_COMPARISON_OPERATORS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}
MAX_LENGTH = 2000
_PARSING = threading.Lock()
"""Lock for the parser: up to 3.12, CPython counts the depth of a tree for all threads together
(issue 106905 of CPython)."""


def parse(text: str, symbols: Mapping[str, sp.Symbol], where: str) -> sp.Expr:
    """Parse an equation.

    Parameters
    ----------
    text
        For example "-force * tanh(v / width)"; ``^`` also denotes a power.
    symbols
        The symbol of each allowed name.
    where
        Start of the error message.

    Raises
    ------
    EffectError
        If the text is not an equation, or contains an unknown name or function.
    """
    if len(text) > MAX_LENGTH:
        raise EffectError(
            f"{where}: must have at most {MAX_LENGTH} characters, but has {len(text)}; shorten it"
        )
    try:
        with _PARSING:
            tree = ast.parse(text.replace("^", "**").strip(), mode="eval")
    except (RecursionError, MemoryError):
        raise _too_deep(where, text) from None
    except (SyntaxError, ValueError) as error:
        said = getattr(error, "msg", error)
        raise EffectError(f"{where}: must be an equation, but {text!r} is not ({said})") from None
    return sp.sympify(_ExpressionReader(symbols, where, text).read(tree.body))


def _shown(text: str) -> str:
    """Return an equation as it is quoted in a message."""
    return repr(text) if len(text) <= 200 else f"{text[:100]!r}..."


def _too_deep(where: str, text: str) -> EffectError:
    return EffectError(
        f"{where}: calls, signs, powers and parentheses may be nested at most {MAX_DEPTH} deep, "
        f"but are nested deeper in {_shown(text)}; simplify it, or write several equations"
    )


def _power(base: Any, exponent: Any) -> Any:
    if isinstance(exponent, sp.Number) and base.is_number and abs(exponent) > MAX_EXPONENT:
        raise OverflowError(f"an exponent must be at most {MAX_EXPONENT}, but is {exponent}")
    if isinstance(base, sp.Number) and isinstance(exponent, sp.Number) and base.is_finite and base:
        digits = abs(float(exponent * sp.log(sp.Abs(base), 10).evalf()))
        if digits > MOST_DIGITS:
            raise OverflowError(
                f"a power must have at most {MOST_DIGITS} digits, but one has {digits:.3g}"
            )
    return base**exponent


def _bounded(value: Any) -> Any:
    """Return the value of a function.

    Raises
    ------
    OverflowError
        If the value is a number larger than `LARGEST_FUNCTION_VALUE`.
    """
    if (
        getattr(value, "is_number", False)
        and value.is_finite
        and abs(value.evalf()) > LARGEST_FUNCTION_VALUE
    ):
        raise OverflowError(
            f"a number must be at most {LARGEST_FUNCTION_VALUE:g} in magnitude, but one is larger"
        )
    return value


def _dotted(node: ast.expr) -> str:
    """Return a name with dots, as in FMUs; empty for any other expression."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (before := _dotted(node.value)):
        return f"{before}.{node.attr}"
    return ""


class _ExpressionReader:
    """Converts a syntax tree to SymPy."""

    def __init__(self, symbols: Mapping[str, sp.Symbol], where: str, text: str) -> None:
        self._symbols, self._where, self._text = symbols, where, text
        self._depth = 0

    def read(self, node: ast.expr) -> Any:
        """Return the SymPy expression of a part of the equation."""
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _too_deep(self._where, self._text)
        found = self._read(node)
        self._depth -= 1
        return found

    def _read(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=bool()):
                pass
            case ast.Constant(value=int() | float() as value):
                exact = isinstance(value, int)
                return self._compute(lambda: sp.Integer(value) if exact else sp.Float(value, 17))
            case ast.Name(id=name):
                return self._look_up(name, self._symbols, "variable")
            case ast.Attribute() if dotted := _dotted(node):
                return self._look_up(dotted, self._symbols, "variable")
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._compute(lambda value: -value, self.read(operand))
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.read(operand)
            case ast.BinOp():
                return self._chain(node)
            case ast.Compare(left=left, ops=[comparison], comparators=[right]) if (
                type(comparison) in _COMPARISON_OPERATORS
            ):
                return _COMPARISON_OPERATORS[type(comparison)](self.read(left), self.read(right))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, arguments)
        raise self._refused(node)

    def _chain(self, node: ast.expr) -> Any:
        """Evaluate consecutive operators, as in a long sum, from the left and without recursion."""
        after: list[tuple[Callable[[Any, Any], Any], ast.expr]] = []
        while isinstance(node, ast.BinOp):
            if type(node.op) not in _ARITHMETIC:
                raise self._refused(node)
            after.append((_ARITHMETIC[type(node.op)], node.right))
            node = node.left
        value = self.read(node)
        for operation, right in reversed(after):
            value = self._compute(operation, value, self.read(right))
        return value

    def _refused(self, node: ast.expr) -> EffectError:
        part = ast.get_source_segment(self._text, node) or self._text
        return EffectError(
            f"{self._where}: must consist of numbers, variables, + - * / ^, comparisons and "
            f"{', '.join(EQUATION_FUNCTIONS)}, but has {part!r}"
        )

    def _compute(self, operation: Callable[..., Any], *values: Any) -> Any:
        try:
            return operation(*values)
        except TypeError:
            raise EffectError(
                f"{self._where}: must not compute with a comparison, but {self._text!r} does; "
                "where(condition, yes, no) turns a comparison into a number"
            ) from None
        except OverflowError as error:
            raise self._out_of_range(error) from None

    def _out_of_range(self, error: OverflowError) -> EffectError:
        return EffectError(f"{self._where}: {error} in {_shown(self._text)}; correct it")

    def _call(self, name: str, arguments: list[ast.expr]) -> Any:
        function = self._look_up(name, EQUATION_FUNCTIONS, "function")
        try:
            return _bounded(function(*(self.read(argument) for argument in arguments)))
        except OverflowError as error:
            raise self._out_of_range(error) from None
        except (TypeError, ValueError) as error:
            raise EffectError(
                f"{self._where}: {name}(...) cannot be used in this way ({error})"
            ) from None

    def _look_up(self, name: str, known: Mapping[str, Any], what: str) -> Any:
        if name not in known:
            raise EffectError(
                f"{self._where}: {self._text!r} contains the unknown {what} "
                f"{name!r}{nearest(name, known)}"
            )
        return known[name]
