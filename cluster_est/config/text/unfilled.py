"""Values that a first config leaves to its author."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

FILL_IN = "FILL IN"
"""Begins a value that only the author knows."""


def unfilled(tree: dict[str, Any], text: str, where: str) -> Iterator[str]:
    """Yield a sentence for each value that still has to be filled in, with its line.

    Parameters
    ----------
    tree
        What was read, with what the command line has changed.
    text
        Of the file.
    where
        Its name.
    """
    lines = text.splitlines()
    for key, value in dict(_texts(tree)).items():
        if not value.startswith(FILL_IN):
            continue
        quoted = json.dumps(value, ensure_ascii=False)
        found = [number for number, line in enumerate(lines, 1) if quoted in line]
        place = f"{where}, line {found[0]}" if found else where
        yield f"{place}: {key} must be filled in but still is {quoted}; write its value there"


def _texts(tree: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield the texts of a tree by their keys."""
    if isinstance(tree, str):
        yield key, tree
    elif isinstance(tree, dict):
        for name, each in tree.items():
            yield from _texts(each, f"{key}.{name}" if key else str(name))
    elif isinstance(tree, list):
        for each in tree:
            own = each.get("id") if isinstance(each, dict) else None
            yield from _texts(each, f"{key}[{own!r}]" if own else key)
