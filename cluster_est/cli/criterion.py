"""The expressions of `--fail-if`: comparisons of fields of a command's document.

An expression is parsed as Python and evaluated here; it is never executed as code.
"""

from __future__ import annotations

import ast
import json
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cluster_est.cli.document import DocumentField, fields_of
from cluster_est.errors import ConfigError
from workers.fmu.description import nearest

MOST_LETTERS = 500
"""Longest expression that is passed to Python's parser."""
ALLOWED = (
    "names with dots, numbers, text in quotes, null, true, false, < <= > >= == !=, in, and, or, "
    "not, and parentheses"
)
_LITERALS = {"null": None, "true": True, "false": False}
_ORDERS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_OTHERS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}


class _NoValueError(Exception):
    """A field that the expression needs is null."""


@dataclass(frozen=True)
class Judgement:
    """Whether a criterion is met; `why` is the reason if it is unknown, which counts as met."""

    expression: str
    met: bool
    why: str = ""

    @property
    def sentence(self) -> str:
        """The result as a sentence."""
        if self.why:
            return (
                f"--fail-if: {self.expression!r} cannot be evaluated and therefore counts as met: "
                f"{self.why}"
            )
        return f"--fail-if: {self.expression!r} is met"


class Criterion:
    """An expression on the fields of one command.

    Parameters
    ----------
    expression
        Text of the expression.
    command
        The command whose document it refers to.

    Raises
    ------
    ConfigError
        If it is invalid, or names an unknown field of the command.
    """

    def __init__(self, expression: str, command: str) -> None:
        self.expression = expression
        self._fields = fields_of(command)
        self._command = command
        if len(expression) > MOST_LETTERS:
            raise ConfigError(
                f"--fail-if: must have at most {MOST_LETTERS} characters, but has "
                f"{len(expression)}; shorten it"
            )
        try:
            self._tree = ast.parse(expression.strip(), mode="eval").body
            self._check(self._tree)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise self._wrong(
                f"but it is not a valid expression ({getattr(error, 'msg', error)})"
            ) from error

    def judge(self, document: Mapping[str, Any]) -> Judgement:
        """Return whether a document meets the criterion.

        Raises
        ------
        ConfigError
            If it names a missing field, or compares values without an order.
        """
        try:
            return Judgement(self.expression, bool(self._value(self._tree, document)))
        except _NoValueError as missing:
            return Judgement(self.expression, True, str(missing))

    def _wrong(self, but: str) -> ConfigError:
        return ConfigError(f"--fail-if: must consist of {ALLOWED}, {but}: {self.expression!r}")

    def _check(self, node: ast.expr, field: DocumentField | None = None) -> None:
        """Refuse forbidden syntax and unknown names; `field` is compared with the node."""
        if isinstance(node, ast.Compare):
            self._check_compare(node)
        elif isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
            self._check_name(node, field)
        elif isinstance(node, ast.BoolOp):
            for each in node.values:
                self._check(each)
        elif isinstance(node, ast.List | ast.Tuple):
            for each in node.elts:
                self._check(each, field)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            self._check(node.operand)
        elif not (isinstance(node, ast.Constant) and isinstance(node.value, str | int | float)):
            raise self._wrong(f"but contains {ast.unparse(node)!r}")

    def _check_compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        known = next((f for f in map(self._field, sides) if f is not None), None)
        for side in sides:
            self._check(side, known)
        if not all(type(each) in _ORDERS or type(each) in _OTHERS for each in node.ops):
            raise self._wrong("but contains another comparison")

    def _field(self, node: ast.expr) -> DocumentField | None:
        return self._fields.get(node.id) if isinstance(node, ast.Name) else None

    def _check_name(self, node: ast.expr, field: DocumentField | None) -> None:
        first = str(_path(node, self._wrong)[0])
        words = field.words() if field is not None else ()
        if first in self._fields or first in _LITERALS or first in words:
            return
        meant = nearest(first, [*words, *self._fields])
        meant = f"{meant} I" if meant.endswith("?") else "; i"
        named = f"{field.name} is one of {', '.join(words)}; " if field and words else ""
        raise ConfigError(
            f"--fail-if: {first!r} must be a field of {self._command}, but is not{meant}ts fields "
            f"are {', '.join(self._fields)}; {named}put text in quotes"
        )

    def _value(self, node: ast.expr, document: Mapping[str, Any]) -> Any:
        if isinstance(node, ast.BoolOp):
            # evaluation stops at the first decisive operand
            decides = isinstance(node.op, ast.Or)
            return decides == any(
                bool(self._value(each, document)) == decides for each in node.values
            )
        if isinstance(node, ast.UnaryOp):
            value = self._value(node.operand, document)
            return not value if isinstance(node.op, ast.Not) else self._negative(value)
        if isinstance(node, ast.Compare):
            return self._compare(node, document)
        if isinstance(node, ast.List | ast.Tuple):
            return [self._value(each, document) for each in node.elts]
        if isinstance(node, ast.Constant):
            return node.value
        return self._looked_up(node, document)

    def _negative(self, value: Any) -> Any:
        if isinstance(value, str | list | dict):
            raise self._wrong("but a minus sign stands before something that is not a number")
        return -value

    def _compare(self, node: ast.Compare, document: Mapping[str, Any]) -> bool:
        sides = [node.left, *node.comparators]
        with_null = any(isinstance(s, ast.Name) and s.id == "null" for s in sides)
        values = [self._value(side, document) for side in sides]
        if not with_null:
            self._refuse_missing(sides, values)
        for order, left, right in zip(node.ops, values, values[1:], strict=False):
            compare = _ORDERS.get(type(order)) or _OTHERS[type(order)]
            try:
                if not compare(left, right):
                    return False
            except TypeError as error:
                raise self._wrong(
                    f"but {left!r} and {right!r} cannot be compared in this way"
                ) from error
        return True

    def _refuse_missing(self, sides: Sequence[ast.expr], values: Sequence[Any]) -> None:
        for side, value in zip(sides, values, strict=True):
            if value is None:
                raise _NoValueError(f"{ast.unparse(side)} has no value in this result")

    def _looked_up(self, node: ast.expr, document: Mapping[str, Any]) -> Any:
        """Return the value of a name: a constant, a field or a part of a field, or a word."""
        path: Sequence[str | int] = _path(node, self._wrong)
        if len(path) == 1 and path[0] in _LITERALS:
            return _LITERALS[str(path[0])]
        if path[0] not in self._fields:
            return path[0]  # a word of the field in the comparison
        value: Any = document
        while path:
            if value is None:
                raise _NoValueError(f"{ast.unparse(node)} has no value in this result")
            value, path = self._step(node, value, path)
        return value

    def _step(
        self, node: ast.expr, value: Any, path: Sequence[str | int]
    ) -> tuple[Any, Sequence[str | int]]:
        """Return the value of the first part of a path, and the parts after it.

        Names of the FMU may contain dots, so the longest existing name is used.
        """
        if isinstance(value, list) and isinstance(path[0], int) and path[0] < len(value):
            return value[path[0]], path[1:]
        if isinstance(value, Mapping):
            for end, name in _joined(path):
                if name in value:
                    return value[name], path[end:]
        raise ConfigError(f"--fail-if: {ast.unparse(node)}: {_no_part(value, path[0])}")


def _no_part(value: Any, part: str | int) -> str:
    """Return why a value has no such field or entry, and which fields it has."""
    if isinstance(value, Mapping) and value:
        found = f"there is no field {part!r}{nearest(str(part), value)}"
        return f"{found} The fields are {', '.join([*value][:20])}."
    if isinstance(value, list) and isinstance(part, int):
        return f"there is no entry [{part}], because the list has {len(value)} entries"
    if isinstance(value, list):
        return (
            f"there is no field {part!r}, because the value is a list of {len(value)} entries; "
            "select an entry by its index, as in [0], or test whether the list contains a value, "
            f"as in {str(part)!r} in LIST"
        )
    return f"there is no field {part!r}, because {json.dumps(value)[:60]} has no fields"


def _joined(path: Sequence[str | int]) -> Iterator[tuple[int, str]]:
    """Yield names made of the first parts of a path, the longest first, with their numbers."""
    for end in range(len(path), 0, -1):
        first, *rest = path[:end]
        parts = (f"[{each}]" if isinstance(each, int) else f".{each}" for each in rest)
        yield end, f"{first}{''.join(parts)}"


def _path(node: ast.expr, wrong: Callable[[str], ConfigError]) -> list[str | int]:
    """Return the parts of a name with dots and brackets."""
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.Attribute):
        return [*_path(node.value, wrong), node.attr]
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        part = node.slice.value
        if isinstance(part, str) or (type(part) is int and part >= 0):
            return [*_path(node.value, wrong), part]
    raise wrong(f"but contains {ast.unparse(node)!r}")
