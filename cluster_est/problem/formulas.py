"""Formulas in parameters: what ties one parameter to others, and constraints on them.

They are parsed, never run as Python.
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
    """A formula such as "2 * k1 + exp(-c)", made ready for arrays.

    Attributes
    ----------
    text
        Numbers, parameters, + - * / ^ and the functions that equations of effects may call.
    known
        Names of the parameters that it may mention.
    where
        Opens the message if something is wrong.

    Raises
    ------
    ProblemError
        If it cannot be read.
    """

    text: str
    known: tuple[str, ...] = field(repr=False)
    where: str = field(default="formula", compare=False, repr=False)

    def __post_init__(self) -> None:
        check_text(self.text, self.where, ProblemError)
        known = as_tuple(self.known, str, f"{self.where}.known", ProblemError)
        object.__setattr__(self, "known", known)
        self.names  # noqa: B018 - what is wrong is said at once

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
        """The parameters that it mentions."""
        return self._parsed[0]

    def values(self, columns: Mapping[str, FloatArray], size: int) -> FloatArray:
        """(size,) values from (size,) values of each parameter; NaN where it has none."""
        names, function = self._parsed
        with np.errstate(all="ignore"):
            found = function(*(columns[name] for name in names))
            return np.broadcast_to(np.asarray(found, np.float64), (size,)).copy()

    def __reduce__(self) -> tuple[Any, ...]:
        """A compiled formula cannot be pickled; its text can."""
        return Formula, (self.text, self.known, self.where)


@dataclass(frozen=True)
class ParameterConstraint:
    """A constraint on parameters: `formula` <= 0, or = 0.

    Attributes
    ----------
    name
        What tables call it.
    formula
        Where it has parameters with a value for each experiment, it must hold in each.
    equality
        Whether it must be 0.
    scale
        What a violation is counted in.

    Raises
    ------
    ProblemError
        If the formula is none, or the scale not positive.
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
    """Read "mu_d <= mu_s", "a + b = 1" or "0 <= x - y <= 1" as constraints.

    Raises
    ------
    ProblemError
        If it has no comparison, or one of its sides cannot be read.
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
            Formula(side, tuple(known), where)  # what is wrong is said in the user's own words
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
    """Cut a text at the comparisons that stand outside of parentheses."""
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
