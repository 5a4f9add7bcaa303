"""Settings: a key is declared once, with its type, limits, default and meaning.

A config and Python make the same class and refuse a wrong value with the same sentence; the page of
keys, the messages and `help` show the same meaning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    Strict,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from cluster_est.errors import ConfigError, ProblemError
from workers.fmu.description import nearest
from workers.messages.checks import shown

LARGEST_INTEGER = 2**63 - 1
"""Largest integer that the simulation core counts with."""
MOST_TIMES = 10_000_000
"""Times at which a signal may be looked at in one experiment: 80 MB of numbers."""


def _known(value: Any) -> Any:
    """A known value keeps its type: the FMU's variable decides which it must be."""
    largest = LARGEST_INTEGER if isinstance(value, int) else float("inf")
    if isinstance(value, str) and "\0" not in value:
        return value
    if isinstance(value, bool | int | float) and abs(value) < largest:
        return value
    raise PydanticCustomError("known", "must be a finite number, true, false or text in quotes")


def as_column(value: Any) -> Any:
    """A column's name alone is short for a table with it."""
    if isinstance(value, str):
        return {"column": value}
    if isinstance(value, dict | BaseModel):
        return value
    raise PydanticCustomError("input", "must be the name of a column or { column, interpolation }")


def as_group(value: Any) -> Any:
    """A label alone is short for a table with it."""
    if isinstance(value, str):
        return {"": value}
    if isinstance(value, dict):
        return value
    raise PydanticCustomError("group", 'must be a label or { KEY = "label" }')


def _free(value: Any) -> Any:
    """A scale or offset is known, one of each experiment, or one of all."""
    if isinstance(value, bool) or value == "shared":
        return value
    raise PydanticCustomError("free", 'must be true, false or "shared"')


def _ordinal(value: Any) -> Any:
    """Whether values say an order alone, or the words that do."""
    if isinstance(value, bool):
        return value
    several = isinstance(value, list | tuple) and len(value) > 1
    if several and all(isinstance(word, str) and word for word in value):
        return list(value)
    raise PydanticCustomError(
        "ordinal", "must be true, false or a list of at least two words, the lowest first"
    )


Count = Annotated[int, Field(ge=0, le=LARGEST_INTEGER)]
Positive = Annotated[int, Field(gt=0, le=LARGEST_INTEGER)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Samples = Annotated[int, Field(gt=1, le=MOST_TIMES)]
KnownValue = Annotated[float | int | bool | str, PlainValidator(_known)]
Free = Annotated[bool | Literal["shared"], PlainValidator(_free)]
Ordinal = Annotated[bool | list[str], PlainValidator(_ordinal)]
Pair = Annotated[tuple[Finite, Finite], Strict(False)]
Names = Annotated[tuple[str, ...], Strict(False)]
"""TOML has lists, which strictly are no tuples."""


class ConfigSection(BaseModel):
    """A section of a config file: strict, frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


Section = TypeVar("Section", bound=BaseModel)


def checked(
    section: type[Section], raw: dict[str, Any], where: str, root: type[BaseModel] | None = None
) -> Section:
    """Return a section of what stands in a file.

    Parameters
    ----------
    section
        Its keys.
    raw
        As read from TOML.
    where
        Opens each message.
    root
        What `raw` is, where the section is only a part of it.

    Raises
    ------
    ConfigError
        With one line for each problem.
    """
    try:
        return section.model_validate(raw)
    except ValidationError as error:
        said = error_messages(error, where, raw, root or section)
        raise ConfigError("\n".join(said)) from None


class Settings(ConfigSection):
    """A section that Python makes too, in the same words.

    Parameters
    ----------
    values
        In the order of the keys, or by their names.

    Raises
    ------
    ProblemError
        If a value is of the wrong kind or out of its range.
    """

    section: ClassVar[str]
    """Where it stands in a config."""
    also: ClassVar[Mapping[str, str]] = {}
    """Other names by which Python may give a key."""

    if not TYPE_CHECKING:  # checkers and editors know the keys

        def __init__(self, *values: Any, **named: Any) -> None:
            keys = list(type(self).model_fields)
            named = {self.also.get(key, key): value for key, value in named.items()}
            if len(values) > len(keys) or named.keys() & keys[: len(values)]:
                raise ProblemError(
                    f"{self.section}: each of {', '.join(keys)} must be given at most once, but "
                    f"{len(values)} values are given without names, and with names "
                    f"{', '.join(named) or 'none'}; give all values with their names"
                )
            given = dict(zip(keys, values, strict=False)) | named
            given = {k: v.item() if isinstance(v, np.generic) else v for k, v in given.items()}
            try:
                super().__init__(**given)
            except ValidationError as error:
                said = error_messages(error, "", given, type(self), self.section)
                raise ProblemError("\n".join(said)) from None

        __init__.__pydantic_base_init__ = True  # so a config is checked as a whole

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Let `help` and editors show the keys."""
        keys = "\n".join(f"{name}\n    {field.description}" for name, field in keys_of(cls))
        cls.__doc__ = f"{cls.__doc__}\n\nAttributes\n----------\n{keys}\n"

    @classmethod
    def of(cls, given: Any) -> Self:
        """Return settings, from what Python may give in their place.

        Parameters
        ----------
        given
            Settings; None for the defaults; keys and values as in a config, {"n": 4}; or the value
            of the first key alone, 4.

        Raises
        ------
        ProblemError
            As for new ones.
        """
        if isinstance(given, cls):
            return given
        if isinstance(given, Settings):
            raise ProblemError(
                f"{cls.section}: must be {cls.__name__}(...), but is {type(given).__name__}(...)"
            )
        if given is None:
            return cls()
        first = next(iter(cls.model_fields))
        return cls(**(given if isinstance(given, Mapping) else {first: given}))

    def __str__(self) -> str:
        return repr(self)

    def changed(self, **values: Any) -> Self:
        """Return a copy with other values, checked as new ones are."""
        now = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**now | {self.also.get(key, key): v for key, v in values.items()})


def keys_of(section: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    """The keys of a section that a config may give: those that have a meaning."""
    for name, field in section.model_fields.items():
        if field.description is not None:
            yield name, field


def sentence(text: str) -> PydanticCustomError:
    """An error whose text says all, the key too."""
    return PydanticCustomError("sentence", "{text}", {"text": text})


def one_of(names: Iterable[str]) -> str:
    """Return the description of a key that takes one of some names."""
    *first, last = names
    return f"{', '.join(first)} or {last}"


_MUST = {
    "string_type": "must be text in quotes",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "tuple_type": "must be a list",
    "is_instance_of": "must be a {class}",
    "list_type": "must be a list",
    "finite_number": "must be a finite number",
    "string_too_short": "must not be empty",
    "too_short": "must have at least one entry",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be {expected}",
}


def error_messages(
    error: ValidationError,
    where: str,
    raw: dict[str, Any],
    root: type[BaseModel],
    section: str = "",
) -> list[str]:
    """Return a message for each problem: where, what it must be, what it is, what to do.

    Parameters
    ----------
    error
        What pydantic found.
    where
        Opens each message; "" for nothing.
    raw
        The config that was checked.
    root
        The class that it was checked against.
    section
        Where `raw` stands in a config; "" for a config itself.
    """
    before = f"{where}: " if where else ""
    found = [f"{before}{_message(problem, raw, root, section)}" for problem in error.errors()]
    return list(dict.fromkeys(found))


def _message(problem: ErrorDetails, raw: dict[str, Any], root: type[BaseModel], inside: str) -> str:
    parts, kind, value = list(problem["loc"]), problem["type"], problem["input"]
    parts = [part for part in parts if part != "[key]"]
    if kind == "sentence":
        return problem["msg"]
    if kind == "extra_forbidden":
        section, _ = _walk(root, parts[:-1])
        known = [key for key, _ in keys_of(section)] if _is_section(section) else []
        belongs = _where_it_belongs(parts, raw, root)
        return f"unknown key {_path(parts, raw, inside)}{nearest(str(parts[-1]), known)}{belongs}"
    hint, meaning = _walk(root, parts)
    parent, _ = _walk(root, parts[:-1])
    one_of_pair = _is_pair(parent)
    if one_of_pair:  # one number of a pair: show both
        parts, hint = parts[:-1], parent
        value = _at(raw, parts)
    path = _path(parts, raw, inside)
    if _is_pair(hint) and (one_of_pair or kind != "missing"):
        whole = _bare(get_args(hint)[0]) is int
        must = "two whole numbers that are not negative" if whole else "two numbers"
        finite = " that are finite" if kind == "finite_number" else ""
        return f"{path}: must be a list of {must}{finite}, but is {shown(value)} ({meaning})"
    if kind == "missing":
        return f"{path} is missing; add it ({meaning})"
    must = _MUST[kind].format(**problem.get("ctx", {})) if kind in _MUST else problem["msg"]
    return f"{path}: {must}, but is {shown(value)}{_advice(kind, value, path)} ({meaning})"


def _where_it_belongs(
    parts: Sequence[int | str], raw: dict[str, Any], root: type[BaseModel]
) -> str:
    """Say where a key belongs that stands too deep; "" where no enclosing section has it."""
    for depth in range(len(parts) - 2, 0, -1):
        section, _ = _walk(root, parts[:depth])
        if _is_section(section) and parts[-1] in dict(keys_of(section)):
            return (
                f"; {str(parts[-1])!r} is a key of {_path(parts[:depth], raw)} itself, so move it "
                "there"
            )
    return ""


def _advice(kind: str, value: Any, path: str) -> str:
    """Return what to do, where that is known."""
    if kind == "literal_error" or not isinstance(value, str | dict):
        return ""
    if kind in ("list_type", "tuple_type") and isinstance(value, str):
        return f"; write [{shown(value)}] for a single value"
    if isinstance(value, dict):
        return "; begin each experiment with [[experiments]]" if path == "experiments" else ""
    number = value.strip().lstrip("+-").replace(".", "", 1).isdigit()
    quoted = number and kind in ("float_type", "int_type")
    quoted = quoted or (value in ("true", "false") and kind == "bool_type")
    return "; remove the quotes" if quoted else ""


def _walk(hint: Any, parts: Sequence[int | str]) -> tuple[Any, str]:
    """The type that a path leads to, and what the last named key on the way is for."""
    meaning = "needed"
    for part in parts:
        if _is_section(hint):
            found = hint.model_fields.get(str(part))
            if found is None:
                return None, meaning
            hint, meaning = found.annotation, found.description or meaning
        else:
            inner = [each for each in get_args(hint) if each is not Ellipsis]
            hint = inner[-1] if inner else None
        hint = _bare(hint)
    return hint, meaning


def _bare(hint: Any) -> Any:
    """Without its annotations, and without None."""
    origin = get_origin(hint)
    if origin is Annotated:
        return _bare(get_args(hint)[0])
    if origin in (Union, UnionType):
        return _bare(next(arg for arg in get_args(hint) if arg is not type(None)))
    return hint


def _is_pair(hint: Any) -> bool:
    return get_origin(hint) is tuple and Ellipsis not in get_args(hint)


def _is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, BaseModel)


def _path(parts: Sequence[int | str], raw: dict[str, Any], text: str = "") -> str:
    """A path as the config's author would say it; an experiment is named by its id."""
    for i, part in enumerate(parts):
        if isinstance(part, int):
            entry = _at(raw, parts[: i + 1])
            name = entry.get("id") if isinstance(entry, dict) else None
            text += f"[{name!r}]" if isinstance(name, str) and name else f"[{part}]"
        else:
            name = part if part.isprintable() else repr(part)
            text += f".{name}" if text else name
    return text


def _at(raw: Any, parts: Sequence[int | str]) -> Any:
    for part in parts:
        raw = raw[part]
    return raw
