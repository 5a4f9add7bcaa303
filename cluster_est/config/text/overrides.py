"""key=value arguments of the command line, put into a config before it is checked."""

from __future__ import annotations

import tomllib
from typing import Any

from cluster_est.errors import ConfigError
from workers.fmu.description import nearest


def override(raw: dict[str, Any], text: str) -> None:
    """Put one key=value into the raw config.

    Parameters
    ----------
    raw
        The config, as read from TOML; it is changed.
    text
        The key has dots; an entry of a list is named by its id or its position. The value is TOML,
        or text where it is not.

    Raises
    ------
    ConfigError
        If it is no key=value, or its key leads nowhere.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(part.strip() for part in key.split(".")) or not text.isprintable():
        raise ConfigError(
            f"{text!r}: must be key=value with dots in the key, like method.options.trials=8"
        )
    *parents, last = _parts(key)
    target: Any = raw
    for part in parents:
        if isinstance(target, dict):
            target = target.setdefault(part, {})
        else:
            target = target[_position(target, part, key)]
        if not isinstance(target, dict | list):
            raise ConfigError(f"{key}: {part!r} is a value, not a table; remove what follows it")
    target[last if isinstance(target, dict) else _position(target, last, key)] = _value(value)


def _parts(key: str) -> list[str]:
    """The key's parts; a part in quotes may hold dots, as an FMU's names do."""
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
    raise ConfigError(f"{key}: there is no {part!r} in that list{nearest(part, known)}")


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
