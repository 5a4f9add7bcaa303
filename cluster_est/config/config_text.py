"""The text of a config: TOML, lines of its keys, overrides, and values still to be filled in."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cluster_est.errors import ConfigError
from workers.fmu.description import nearest


def read_toml(path: Path, missing: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a file and its TOML tree.

    Parameters
    ----------
    path
        Path of a config, a sweep file or a limits file.
    missing
        Start of the error message if there is no such file.

    Raises
    ------
    ConfigError
        If it cannot be read, or is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        return text, tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"{missing} {path}; check the path") from None
    except UnicodeDecodeError as error:
        if path.suffix.lower() == ".fmu":
            raise ConfigError(
                f"{path}: must be a config, but is an FMU; write a config for it with cluster-est "
                "init"
            ) from None
        raise ConfigError(
            f"{path}: must be text in UTF-8, but is not ({error.reason} at byte {error.start}); "
            "save it as UTF-8"
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: must be a readable file, but is not ({error.strerror}); check the path"
        ) from error
    except (ValueError, RecursionError) as error:  # tomllib also raises others
        raise ConfigError(f"{path}: must be TOML, but is not: {error}; correct that line") from None


_NAME = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*\[(\[?)\s*({_KEY})\s*\]")
_ASSIGNED = re.compile(rf"\s*({_KEY})\s*=")
_KEY_PART = re.compile(_NAME)
_ID = re.compile(r"""\s*id\s*=\s*["']([^"']*)["']""")
EXPERIMENTS = "experiments"


def with_lines(message: str, path: Path, overridden: Sequence[str] = ()) -> str:
    """Add the file and the line to each line of a message that begins with a key.

    Parameters
    ----------
    message
        An error message, such as "parameters.k.bounds: must be ...", possibly with the file.
    path
        Path of the config; if it cannot be read, the message is not changed.
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
    """Return whether a key is the name of a line, or is below this name."""
    return key == name or key.startswith((f"{name}.", f"{name}["))


def _assignments(text: str) -> Iterator[tuple[str, int]]:
    """Yield the complete name and the line of each assignment and each table."""
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
    return ".".join(part.strip("\"'") for part in _KEY_PART.findall(key))


def _id_below(lines: list[str]) -> str:
    """Return the id of the experiment whose table begins before these lines."""
    for line in lines:
        if _HEADER.match(line) is not None:
            break
        found = _ID.match(line)
        if found is not None:
            return found[1]
    return ""


def override(raw: dict[str, Any], text: str) -> None:
    """Set one key=value in a raw config.

    Parameters
    ----------
    raw
        The config, as read from TOML; it is changed.
    text
        The key contains dots; an entry of a list is named by its id or its position. The value is
        TOML, otherwise text.

    Raises
    ------
    ConfigError
        If it is not key=value, or its key does not exist.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(part.strip() for part in key.split(".")) or not text.isprintable():
        raise ConfigError(
            f"{text!r}: must be KEY=VALUE with a dot between the parts of the key, as in "
            "method.options.trials=8"
        )
    *parents, last = _parts(key)
    target: Any = raw
    for part in parents:
        if isinstance(target, dict):
            target = target.setdefault(part, {})
        else:
            target = target[_position(target, part, key)]
        if not isinstance(target, dict | list):
            raise ConfigError(
                f"{key}: {part!r} is a value, not a table; remove the part of the key after it"
            )
    target[last if isinstance(target, dict) else _position(target, last, key)] = _value(value)


def _parts(key: str) -> list[str]:
    """Return the parts of a key; a part in quotes may contain dots, as names in FMUs do."""
    try:
        found: Any = tomllib.loads(f"{key} = 0")
    except ValueError:
        return [part.strip() for part in key.split(".")]
    parts = []
    while isinstance(found, dict):
        ((part, found),) = found.items()
        parts.append(part)
    return parts


def _position(entries: list[Any], part: str, key: str) -> int:
    names = [e.get("id") if isinstance(e, dict) else None for e in entries]
    if part in names:
        return names.index(part)
    if part.isascii() and part.isdigit() and int(part[:9]) < len(entries):
        return int(part[:9])
    known = [str(i) if name is None else str(name) for i, name in enumerate(names)]
    raise ConfigError(f"{key}: the list has no entry {part!r}{nearest(part, known)}")


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


FILL_IN = "FILL IN"
"""Start of a placeholder for a value that the user must fill in."""


def unfilled(tree: dict[str, Any], text: str, where: str) -> Iterator[str]:
    """Yield a sentence, with its line, for each value that must still be filled in.

    Parameters
    ----------
    tree
        The TOML tree with the overrides of the command line.
    text
        Text of the file.
    where
        Name of the file.
    """
    lines = text.splitlines()
    for key, value in dict(_texts(tree)).items():
        if not value.startswith(FILL_IN):
            continue
        quoted = json.dumps(value, ensure_ascii=False)
        found = [number for number, line in enumerate(lines, 1) if quoted in line]
        place = f"{where}, line {found[0]}" if found else where
        yield (
            f"{place}: {key} must be filled in, but is still {quoted}; replace this text by the "
            "value"
        )


def _texts(tree: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield the texts of a tree with their keys."""
    if isinstance(tree, str):
        yield key, tree
    elif isinstance(tree, dict):
        for name, each in tree.items():
            yield from _texts(each, f"{key}.{name}" if key else str(name))
    elif isinstance(tree, list):
        for each in tree:
            own = each.get("id") if isinstance(each, dict) else None
            yield from _texts(each, f"{key}[{own!r}]" if own else key)
