"""Writing TOML: the standard library only reads it."""

from __future__ import annotations

import json
import math
import re
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def to_toml(tree: dict[str, Any]) -> str:
    """A TOML document of nested dicts, lists and plain values; None is left out.

    Parameters
    ----------
    tree
        Keys with a dict become tables, keys with a list of dicts arrays of tables.
    """
    return "\n".join(_table(tree, ())).strip() + "\n"


def inline(value: Any) -> str:
    """A value on one line; a dict as an inline table."""
    return _value(value)


def dotted(*parts: str) -> str:
    """A key of several parts, each in quotes where it needs them."""
    return ".".join(_key(part) for part in parts)


def _table(tree: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    lines: list[str] = []
    for key, value in tree.items():
        if value is not None and not _is_table(value) and not _is_tables(value):
            lines.append(f"{_key(key)} = {_value(value)}")
    for key, value in tree.items():
        deeper = (*path, key)
        header = dotted(*deeper)
        if _is_table(value):
            lines += ["", f"[{header}]", *_table(value, deeper)]
        elif _is_tables(value):
            for item in value:
                lines += ["", f"[[{header}]]", *_table(item, deeper)]
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if math.isnan(value):
            return "nan"
        return repr(float(value)) if math.isfinite(value) else ("inf" if value > 0 else "-inf")
    if isinstance(value, int):
        return str(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    if isinstance(value, dict):
        pairs = (f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None)
        return "{ " + ", ".join(pairs) + " }"
    return _text(str(value))


def _text(text: str) -> str:
    """A basic string; JSON's differ in that they may hold a bare DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
