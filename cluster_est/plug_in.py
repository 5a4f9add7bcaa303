"""What is asked of every class that somebody adds: a method, a cost, an executor."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Mapping
from inspect import get_annotations
from typing import Any, Literal, get_args, get_origin, get_type_hints

from cluster_est.errors import ClusterEstError
from workers.messages.checks import is_finite, shown


def check_class_attributes(derived: type) -> None:
    """Refuse a class that sets a `ClassVar` of its base as if it were one of its options.

    Without `ClassVar` a dataclass takes `name: str = "fair"` for a field: an option that a config
    could change, and that comes before the options without a default.

    Parameters
    ----------
    derived
        A class that is being made, as `__init_subclass__` is given it.

    Raises
    ------
    TypeError
        With the line to write, when the class is imported.
    """
    declared = {
        name: annotation
        for base in derived.__mro__[1:]
        for name, annotation in get_annotations(base).items()
        if "ClassVar" in str(annotation)
    }
    for name, annotation in get_annotations(derived).items():
        if name in declared and "ClassVar" not in str(annotation):
            raise TypeError(
                f"{derived.__module__}.{derived.__qualname__}.{name}: must be declared for the "
                f"class, but is an option; write {name}: {declared[name]}"
            )


_TYPES: dict[Any, tuple[Any, str]] = {
    float: (numbers.Real, "a number"),
    int: (numbers.Integral, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "text in quotes"),
}


def check_options(chosen: Any, where: str, error: type[ClusterEstError]) -> None:
    """Check every option of a method, a cost or settings that were made in Python.

    Parameters
    ----------
    chosen
        A dataclass; fields of other types than numbers, texts and choices are left to it.
    where
        Opens each message.
    error
        What is raised.
    """
    if not dataclasses.is_dataclass(chosen):
        return
    try:
        hints = get_type_hints(type(chosen))
    except NameError:  # a class of the user's may be annotated with what only a type checker sees
        return
    for field in dataclasses.fields(chosen):
        hint = hints[field.name]
        if hint in _TYPES or get_origin(hint) is Literal:
            value = getattr(chosen, field.name)
            check_option(f"{where}.{field.name}", value, hint, field.metadata, error)


def check_option(
    where: str, value: Any, hint: Any, limits: Mapping[str, Any], error: type[ClusterEstError]
) -> None:
    """Check one option.

    Parameters
    ----------
    where
        Opens the message.
    value, hint
        Its value and the type that it must have.
    limits
        `least` and `most` that it may be, as far as there are any.
    error
        What is raised.
    """
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            choices = ", ".join(repr(choice) for choice in get_args(hint))
            raise error(f"{where}: must be one of {choices}, but is {shown(value)}")
        return
    allowed, called = _TYPES.get(hint, (hint, getattr(hint, "__name__", "of another type")))
    if not isinstance(value, allowed) or isinstance(value, bool) is not (hint is bool):
        raise error(f"{where}: must be {called}, but is {shown(value)}")
    if hint is not str and not _usual(value, hint):
        raise error(f"{where}: must be finite and fit into a double, but is {shown(value)}")
    least, most = limits.get("least"), limits.get("most")
    if least is not None and not value >= least:
        raise error(f"{where}: must be at least {least:g}, but is {shown(value)}")
    if most is not None and not value <= most:
        raise error(f"{where}: must be at most {most:g}, but is {shown(value)}")


def _usual(value: Any, hint: Any) -> bool:
    """Whether a number is of a size that computations with it bear."""
    if hint is float:
        return is_finite(value) and abs(float(value)) < 1e100
    return bool(abs(value) < 2**63)
