"""The lines of a config that messages speak of."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

_NAME = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*\[(\[?)\s*({_KEY})\s*\]")
_ASSIGNED = re.compile(rf"\s*({_KEY})\s*=")
_PART = re.compile(_NAME)
_ID = re.compile(r"""\s*id\s*=\s*["']([^"']*)["']""")
EXPERIMENTS = "experiments"


def with_lines(message: str, path: Path, overridden: Sequence[str] = ()) -> str:
    """Put the file and the line in front of each line of a message that begins with a key.

    Parameters
    ----------
    message
        Of an error, such as "parameters.k.bounds: must be ...", perhaps with the file already.
    path
        Of the config; the message stays as it is where that cannot be read.
    overridden
        Keys whose values are not those of the file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return message
    places = list(_assignments(text))
    lines = message.split("\n")
    return "\n".join(_with_line(line, path, places, overridden) for line in lines)


def _with_line(
    said: str, path: Path, places: list[tuple[str, int]], overridden: Sequence[str]
) -> str:
    bare = said.removeprefix(f"{path}: ")
    key = re.split(r": |; ", bare.removeprefix("unknown key "), maxsplit=1)[0]
    fitting = [(len(name), number) for name, number in places if _leads_to(name, key)]
    if not fitting or any(_leads_to(name, key) or _leads_to(key, name) for name in overridden):
        return said
    deepest = max(length for length, _ in fitting)
    number = next(number for length, number in fitting if length == deepest)
    return f"{path}, line {number}: {bare}"


def _leads_to(name: str, key: str) -> bool:
    """Return whether a key is the name of a line, or inside of what stands there."""
    return key == name or key.startswith((f"{name}.", f"{name}["))


def _assignments(text: str) -> Iterator[tuple[str, int]]:
    """Yield the whole name and the line of each assignment and each table."""
    lines = text.splitlines()
    table = ""
    for number, line in enumerate(lines, 1):
        header, assigned = _HEADER.match(line), _ASSIGNED.match(line)
        if header is not None:
            table = _joined(header[2])
            if header[1] and table == EXPERIMENTS:
                table = f"{EXPERIMENTS}[{_id_below(lines[number:])!r}]"
            yield table, number
        elif assigned is not None:
            name = _joined(assigned[1])
            yield f"{table}.{name}" if table else name, number


def _joined(key: str) -> str:
    return ".".join(part.strip("\"'") for part in _PART.findall(key))


def _id_below(lines: list[str]) -> str:
    """Return the id of the experiment whose table begins above these lines."""
    for line in lines:
        if _HEADER.match(line) is not None:
            break
        found = _ID.match(line)
        if found is not None:
            return found[1]
    return ""
