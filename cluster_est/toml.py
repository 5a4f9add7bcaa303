"""TOML as text: `tomli_w` writes it; here stands what a config needs beyond that.

None has no word in TOML: a key with it is left out. Values that TOML does not know are written as
text.
"""

from __future__ import annotations

import re
from typing import Any

import tomli_w

BARE = re.compile("[A-Za-z0-9_-]+")
"""A key that needs no quotes."""


def to_toml(tree: dict[str, Any]) -> str:
    """Return a TOML document of nested dicts, lists and plain values.

    Parameters
    ----------
    tree
        Keys with a dict become tables; keys with a list of dicts become arrays of tables, or stand
        on one line for each dict where all of them are short.
    """
    return tomli_w.dumps(_plain(tree))


def inline(value: Any) -> str:
    """Return a value on one line, where `tomli_w` would take several for a list or a dict."""
    value = _plain(value)
    if isinstance(value, list):
        return "[" + ", ".join(inline(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{dotted(k)} = {inline(v)}" for k, v in value.items()) + " }"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")


def dotted(*parts: str) -> str:
    """Return a key of several parts, each in quotes where it needs them.

    What a message or a config says of a key is written here, so that it can be pasted: a name of an
    FMU may have points, blanks and brackets.
    """
    return ".".join(
        part if BARE.fullmatch(part) else tomli_w.dumps({part: 0}).removesuffix(" = 0\n")
        for part in parts
    )


def _plain(value: Any) -> Any:
    """Return a tree of dicts, lists and values that TOML knows, without keys that are None."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, bool | int | str):
        return value
    return float(value) if isinstance(value, float) else str(value)
