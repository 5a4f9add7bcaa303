"""Checks of user input: a value, a choice, or a list of values of one type.

Each raises an error of a given class. Its message says where the value is, what is required, what
was found, and what to do.
"""

from __future__ import annotations

import math
import numbers
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from workers.errors import ClusterEstError

Item = TypeVar("Item")


def shown(value: object) -> str:
    """Return a value as shown in a message: on one line and not too long."""
    if isinstance(value, bool):
        return str(value).lower()
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) < 60 else text[:57] + "..."


def is_number(value: object) -> bool:
    """Return whether a value is a real number; Booleans are not numbers."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def check_number(
    value: object,
    where: str,
    error: type[ClusterEstError],
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    whole: bool = False,
) -> None:
    """Check that a value is a finite number in a range.

    Parameters
    ----------
    value
        The value.
    where
        Start of the error message.
    error
        Class of the error.
    above, least, below
        It must be greater than `above`, at least `least` and less than `below`.
    whole
        Whether it must be an integer.
    """
    kind = "a whole number" if whole else "a number"
    if not is_number(value) or (whole and not isinstance(value, numbers.Integral)):
        raise error(f"{where}: must be {kind}, but is {shown(value)}")
    if not is_finite(value):
        usual = " that fits into a double" if isinstance(value, int) else ""
        raise error(f"{where}: must be a finite number{usual}, but is {_plain(value)}")
    number = float(value)  # type: ignore[arg-type]
    for kept, limit, words in (
        (number > above, above, "greater than"),
        (number >= least, least, "at least"),
        (number < below, below, "less than"),
    ):
        if not kept:
            wanted, given = told_apart(limit, number)
            raise error(f"{where}: must be {words} {wanted}, but is {given}")


def told_apart(*numbers: float) -> list[str]:
    """Write numbers with six digits, or with all digits if two different numbers look equal."""
    short = [f"{number:g}" for number in numbers]
    exact = [repr(float(number)).removesuffix(".0") for number in numbers]
    return short if len(set(short)) == len(set(exact)) else exact


MOST_NAMES, MOST_CHARACTERS = 4, 40
"""Most names, and most characters of them, in the short form of a value."""


def few_names(names: Sequence[str]) -> str:
    """Return the first few names, and the number of the others."""
    kept = list(names[:MOST_NAMES])
    while len(kept) > 1 and len(", ".join(kept)) > MOST_CHARACTERS:
        kept.pop()
    left = len(names) - len(kept)
    return ", ".join(kept) + (f" and {left} more" if left else "")


def check_choice(
    value: object, choices: Iterable[str], where: str, error: type[ClusterEstError]
) -> None:
    """Check that a value is one of the choices."""
    names = tuple(choices)
    if not isinstance(value, str) or value not in names:
        listed = ", ".join(repr(name) for name in names[:-1])
        must = f"{listed} or {names[-1]!r}" if listed else repr(names[-1])
        raise error(f"{where}: must be {must}, but is {shown(value)}")


def as_path(value: object, where: str, error: type[ClusterEstError]) -> Path:
    """Return a value as a path; raise an error if it is none."""
    if not isinstance(value, str | PathLike) or not str(value):
        raise error(f"{where}: must be a path, but is {shown(value)}")
    return Path(value)


def check_once(names: Sequence[str], where: str, error: type[ClusterEstError]) -> None:
    """Check that no name appears twice."""
    for name, count in Counter(names).items():
        if count > 1:
            raise error(f"{where} {name!r}: must appear once, but appears twice; remove one")


def is_finite(value: Any) -> bool:
    """Return whether a number is finite as a double."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def check_flag(value: object, where: str, error: type[ClusterEstError]) -> None:
    """Check that a value is true or false; NumPy's Booleans are accepted."""
    if not isinstance(value, bool | np.bool_):
        raise error(f"{where}: must be true or false, but is {shown(value)}")


def check_text(value: object, where: str, error: type[ClusterEstError]) -> None:
    """Check that a value is text, which may be empty."""
    if not isinstance(value, str):
        raise error(f"{where}: must be text, but is {shown(value)}")


def check_name(value: object, where: str, error: type[ClusterEstError]) -> None:
    """Check that a value is nonempty text."""
    check_text(value, where, error)
    if not value:
        raise error(f"{where}: must not be empty, but is; give it a name")


def check_kind(
    value: object, kind: type, where: str, error: type[ClusterEstError], advice: str = ""
) -> None:
    """Check that a value is an instance of a class, and not the class itself."""
    if isinstance(value, kind):
        return
    name = "dict" if kind is Mapping else kind.__name__
    if isinstance(value, type) and issubclass(value, kind):
        raise error(
            f"{where}: must be {_a(name)}, but is the class; call it: {value.__name__}(...)"
        )
    raise error(f"{where}: must be {_a(name)}, but is {shown(value)}{advice}")


def as_tuple(
    values: Any, kind: type[Item], where: str, error: type[ClusterEstError]
) -> tuple[Item, ...]:
    """Return a list of values of one type as a tuple."""
    name = kind.__name__ if kind is not str else "text"
    if isinstance(values, kind):
        raise error(
            f"{where}: must be a list of {name}, but is a single one; put it in brackets: [...]"
        )
    if not isinstance(values, Iterable) or isinstance(values, str | bytes):
        raise error(f"{where}: must be a list of {name}, but is {shown(values)}")
    found = values if type(values) is tuple else tuple(values)
    for i, value in enumerate(found):
        if not isinstance(value, kind):
            raise error(f"{where}[{i}]: must be {_a(name)}, but is {shown(value)}")
    return found


def as_pairs(values: Any, where: str, error: type[ClusterEstError]) -> tuple[tuple[str, Any], ...]:
    """Return a dict or an iterable of pairs as a tuple of pairs (name, value)."""
    if hasattr(values, "items"):
        values = values.items()
    if not isinstance(values, Iterable) or isinstance(values, str | bytes):
        raise error(f"{where}: must be a dict, but is {shown(values)}; write {{name: value}}")
    found = tuple(values) if type(values) is not tuple else values
    for pair in found:
        if not (isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], str)):
            raise error(
                f"{where}: must contain pairs (name, value), but contains {shown(pair)}; write "
                "{name: value}"
            )
    return tuple(pair if type(pair) is tuple else tuple(pair) for pair in found)


def _plain(value: Any) -> str:
    """Return the text of an infinite number, NaN, or a number that is too large for a double."""
    try:
        return str(float(value))
    except OverflowError:
        return shown(value)


def _a(name: str) -> str:
    if name == "text":
        return name
    vowel = name[0] in "AEIOU" and not name.startswith("User")
    return f"{'an' if vowel else 'a'} {name}"
