"""Error messages about a config, in the words of its author."""

from __future__ import annotations

from collections.abc import Sequence
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from workers.fmu.description import nearest
from workers.messages.checks import shown

_MUST = {
    "string_type": "must be text in quotes",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "dict_type": "must be a table",
    "model_type": "must be a table",
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
    error: ValidationError, where: str, raw: dict[str, Any], root: type[BaseModel]
) -> list[str]:
    """Return a message for each problem: where, what it must be, what it is, what to do.

    Parameters
    ----------
    error
        What pydantic found.
    where
        Opens each message.
    raw
        The config that was checked.
    root
        The class that it was checked against.
    """
    found = [f"{where}: {_message(problem, raw, root)}" for problem in error.errors()]
    return list(dict.fromkeys(found))


def _message(problem: ErrorDetails, raw: dict[str, Any], root: type[BaseModel]) -> str:
    parts, kind, value = list(problem["loc"]), problem["type"], problem["input"]
    if kind == "extra_forbidden":
        section, _ = _walk(root, parts[:-1])
        known = section.model_fields if _is_section(section) else []
        belongs = _where_it_belongs(parts, raw, root)
        return f"unknown key {_path(parts, raw)}{nearest(str(parts[-1]), known)}{belongs}"
    hint, meaning = _walk(root, parts)
    parent, _ = _walk(root, parts[:-1])
    one_of_pair = get_origin(parent) is tuple
    if one_of_pair:  # one number of a pair: show both
        parts, hint = parts[:-1], parent
        value = _at(raw, parts)
    path = _path(parts, raw)
    if get_origin(hint) is tuple and (one_of_pair or kind != "missing"):
        whole = _bare(get_args(hint)[0]) is int
        must = "two whole numbers from 0" if whole else "two numbers"
        finite = " that are finite" if kind == "finite_number" else ""
        return f"{path}: must be a list of {must}{finite} but is {shown(value)} ({meaning})"
    if kind == "missing":
        return f"{path} is missing; add it ({meaning})"
    must = _MUST[kind].format(**problem.get("ctx", {})) if kind in _MUST else problem["msg"]
    return f"{path}: {must} but is {shown(value)}{_advice(kind, value, path)} ({meaning})"


def _where_it_belongs(
    parts: Sequence[int | str], raw: dict[str, Any], root: type[BaseModel]
) -> str:
    """Say where a key belongs that stands too deep; "" where no enclosing section has it."""
    for depth in range(len(parts) - 2, 0, -1):
        section, _ = _walk(root, parts[:depth])
        if _is_section(section) and parts[-1] in section.model_fields:
            return f"; {str(parts[-1])!r} is a key of {_path(parts[:depth], raw)} itself"
    return ""


def _advice(kind: str, value: Any, path: str) -> str:
    """Return what to do, where that is known."""
    if kind == "literal_error" or not isinstance(value, str | dict):
        return ""
    if isinstance(value, dict):
        return "; open each entry with [[experiments]]" if path == "experiments" else ""
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
            inner = get_args(hint)
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


def _is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, BaseModel)


def _path(parts: Sequence[int | str], raw: dict[str, Any]) -> str:
    """A path as the config's author would say it; an experiment is named by its id."""
    text = ""
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
