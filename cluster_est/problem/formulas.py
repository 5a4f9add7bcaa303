"""Formulas of parameters: expressions that compute a parameter from others, and constraints.

The texts are parsed and never run as Python code.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from cluster_est.errors import ProblemError
from workers.errors import EffectError
from workers.messages import FloatArray
from workers.messages.checks import (
    as_tuple,
    check_flag,
    check_kind,
    check_name,
    check_number,
    check_text,
)

_COMPARISON = re.compile(r"<=|>=|==|=|<|>")
LARGEST_FORMULA_NUMBER = 1e300
"""Largest number in a formula."""


@dataclass(frozen=True)
class Formula:
    """A formula such as "2 * k1 + exp(-c)", which can be evaluated for arrays.

    Attributes
    ----------
    text
        Numbers, parameters, + - * / ^ and the functions allowed in equations of effects.
    known
        Names of the parameters that the formula may contain.
    where
        Start of error messages.

    Raises
    ------
    ProblemError
        If the text is not a valid formula.
    """

    text: str
    known: tuple[str, ...] = field(repr=False)
    where: str = field(default="formula", compare=False, repr=False)

    def __post_init__(self) -> None:
        check_text(self.text, self.where, ProblemError)
        known = as_tuple(self.known, str, f"{self.where}.known", ProblemError)
        object.__setattr__(self, "known", known)
        self.names  # noqa: B018 - raises errors immediately

    @cached_property
    def _parsed(self) -> tuple[tuple[str, ...], Callable[..., Any]]:
        import sympy as sp  # takes long to import

        from workers.effects.expression import parse

        symbols = {name: sp.Symbol(f"p{i}", real=True) for i, name in enumerate(self.known)}
        try:
            parsed = parse(self.text, symbols, self.where)
        except EffectError as error:
            raise ProblemError(str(error)) from None
        if not isinstance(parsed, sp.Expr):
            raise ProblemError(
                f"{self.where}: must be a number for all values of the parameters, but "
                f"{self.text!r} is true or false; remove the comparison"
            )
        if parsed.has(sp.zoo, sp.nan, sp.oo, -sp.oo, sp.I) or any(
            not abs(number) < LARGEST_FORMULA_NUMBER for number in parsed.atoms(sp.Number)
        ):
            raise ProblemError(
                f"{self.where}: must have a finite value, but {self.text!r} has none; correct its "
                "numbers, divisions, roots and logarithms"
            )
        names = tuple(name for name, symbol in symbols.items() if symbol in parsed.free_symbols)
        return names, sp.lambdify([symbols[name] for name in names], parsed, "numpy")

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters in the formula."""
        return self._parsed[0]

    def values(self, columns: Mapping[str, FloatArray], size: int) -> FloatArray:
        """Return values (size,) from values (size,) of each parameter; NaN if undefined."""
        names, function = self._parsed
        with np.errstate(all="ignore"):
            found = function(*(columns[name] for name in names))
            return np.broadcast_to(np.asarray(found, np.float64), (size,)).copy()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the text, because a compiled formula cannot be pickled."""
        return Formula, (self.text, self.known, self.where)


@dataclass(frozen=True)
class ParameterConstraint:
    """A constraint on parameters: `formula` <= 0, or = 0.

    Attributes
    ----------
    name
        Name of the constraint in tables.
    formula
        The formula. If it contains parameters with one value per experiment, the constraint must
        hold in each experiment.
    equality
        Whether the formula must be 0.
    scale
        Unit in which a violation is measured.

    Raises
    ------
    ProblemError
        If `formula` is not a `Formula`, or the scale is not positive.
    """

    name: str
    formula: Formula
    equality: bool = False
    scale: float = 1.0

    def __post_init__(self) -> None:
        check_name(self.name, "constraint.name", ProblemError)
        where = f"constraint {self.name!r}"
        advice = "; make constraints from a text with parse_constraint(text, parameters, where)"
        check_kind(self.formula, Formula, f"{where}.formula", ProblemError, advice)
        check_flag(self.equality, f"{where}.equality", ProblemError)
        check_number(self.scale, f"{where}.scale", ProblemError, above=0.0)


def parse_constraint(
    text: str, known: Sequence[str], where: str, name: str = "", scale: float = 1.0
) -> list[ParameterConstraint]:
    """Parse a text such as "mu_d <= mu_s", "a + b = 1" or "0 <= x - y <= 1" as constraints.

    Raises
    ------
    ProblemError
        If the text has no comparison or no parameter, or one of its sides is not a formula.
    """
    parts, signs = _sides(text)
    if not 2 <= len(parts) <= 3 or not all(part.strip() for part in parts):
        raise ProblemError(
            f"{where}: must be two formulas with <=, >= or = between them, but is {text!r}"
        )
    found = []
    for i, sign in enumerate(signs):
        left, right = parts[i].strip(), parts[i + 1].strip()
        falling = sign in (">=", ">")
        low, high = (right, left) if falling else (left, right)
        for side in (left, right):
            Formula(side, tuple(known), where)  # an error message then shows the user's text
        formula = Formula(f"({low}) - ({high})", tuple(known), where)
        if not formula.names:
            raise ProblemError(
                f"{where}: must name a parameter, but {text!r} names none; use the "
                "names under [parameters]"
            )
        called = name or text.strip()
        if len(signs) > 1:
            called += f" ({'lower' if (i == 0) is not falling else 'upper'})"
        found.append(ParameterConstraint(called, formula, sign in ("=", "=="), scale))
    return found


def _sides(text: str) -> tuple[list[str], list[str]]:
    """Split a text at the comparison signs outside of parentheses."""
    parts, signs, depth, begin = [], [], 0, 0
    i = 0
    while i < len(text):
        depth += (text[i] == "(") - (text[i] == ")")
        found = _COMPARISON.match(text, i)
        if found and depth == 0:
            parts.append(text[begin:i])
            signs.append(found.group())
            begin = i = found.end()
        else:
            i += 1
    return [*parts, text[begin:]], signs
