"""Entries of `[[experiments]]` that represent several experiments: file patterns and tests.

They are expanded in the raw tree before it is checked, into one experiment for each file and test.
So no other module handles patterns, and the config saved by a run names every experiment.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cluster_est.config.experiment_keys import DEFAULTS
from cluster_est.errors import ConfigError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.measured_table import Reading

Section = dict[str, Any]
_NUMBERS = re.compile(r"(\d+)")


def with_every_experiment(raw: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return a config's tree with an experiment for each file of a pattern and each test of a file.

    Files and tests that another entry names explicitly are omitted.

    Parameters
    ----------
    raw
        The tree, as read from TOML; it is not changed.
    base
        Folder to which paths are relative.

    Raises
    ------
    ConfigError
        If no file matches a pattern.
    DataError
        If a file with several tests cannot be read.
    """
    given, defaults = raw.get("experiments"), raw.get(DEFAULTS, {})
    if not isinstance(given, list) or not isinstance(defaults, dict):
        return dict(raw)
    folders = raw.get("data_folders", [])
    folders = folders if isinstance(folders, list) else []
    files: list[Section] = []
    named = [name for own in given for name in _names(own, {})]
    for own in given:
        files += _of_files(own, defaults, base, folders, named)
    tests: list[Section] = []
    for own in files:
        tests += _of_tests(own, defaults, base, folders, files)
    return {**raw, "experiments": tests}


def _names(own: Any, defaults: Mapping[str, Any]) -> list[str]:
    """Return the paths of an experiment's table or tables."""
    if not isinstance(own, dict):
        return []
    data = own.get("data", defaults.get("data", ""))
    return [each for each in (data if isinstance(data, list) else [data]) if isinstance(each, str)]


def _data(own: Any, defaults: Mapping[str, Any]) -> str:
    """Return the path of an experiment's only table; "" if it has none or several."""
    names = _names(own, defaults)
    return names[0] if len(names) == 1 else ""


def _of_files(
    own: Any, defaults: Section, base: Path, folders: list[Any], named: list[str]
) -> Iterator[Any]:
    names = _names(own, defaults)
    if isinstance(own, dict) and isinstance(own.get("data", defaults.get("data")), list):
        if any("*" in name for name in names):  # all matching files are those of one test
            own = own | {"data": [*_joined(own, names, base, folders)]}
        yield own
        return
    data = _data(own, defaults)
    if "*" not in data or next(_found(data, base, folders, whole=True), None) is not None:
        yield own
        return
    others = {
        path.resolve() for each in named if each != data for path in _named(each, base, folders)
    }
    for path in _matching(own, data, base, folders, others):
        yield own | {"data": _relative(path, base), "id": _id(own, path.stem)}


def _joined(own: Section, names: list[str], base: Path, folders: list[Any]) -> Iterator[str]:
    """Yield the files of one test, in place of patterns for them."""
    for name in names:
        if "*" not in name or next(_found(name, base, folders, whole=True), None) is not None:
            yield name
        else:
            paths = _matching(own, name, base, folders, set())
            yield from (_relative(path, base) for path in paths)


def _matching(
    own: Section, data: str, base: Path, folders: list[Any], others: set[Path]
) -> list[Path]:
    """Return the files of a pattern, without others."""
    paths = sorted(set(_found(data, base, folders)), key=_in_order)
    paths = [path for path in paths if path.resolve() not in others]
    if not paths:
        raise ConfigError(
            f"experiment {own.get('id', '')!r}.data: no file matches {data!r}; check the pattern, "
            "or add its folder to data_folders"
        )
    return paths


def _relative(path: Path, base: Path) -> str:
    return os.path.relpath(path, base).replace(os.sep, "/")


def _named(data: str, base: Path, folders: list[Any]) -> Iterator[Path]:
    """Yield the file that an experiment names explicitly."""
    if data and "*" not in data:
        yield from _found(data, base, folders, whole=True)


def _found(data: str, base: Path, folders: list[Any], *, whole: bool = False) -> Iterator[Path]:
    """Yield the files of a pattern or name in the config's folder and the data folders."""
    for folder in [".", *map(str, folders)]:
        place = os.path.expanduser(os.path.expandvars(os.path.join(folder, data)))
        path = base / place
        try:
            if whole:
                yield from [path] if path.is_file() else []
                continue
            anchor = Path(path.anchor or ".")
            pattern = str(path.relative_to(path.anchor)) if path.anchor else str(path)
            yield from (each for each in anchor.glob(os.path.normpath(pattern)) if each.is_file())
        except (OSError, ValueError, NotImplementedError):
            continue


def _in_order(path: Path) -> tuple[Any, ...]:
    """Return a sort key that places run2 before run10."""
    parts = _NUMBERS.split(str(path))
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in parts)


def _of_tests(
    own: Any, defaults: Section, base: Path, folders: list[Any], others: list[Any]
) -> Iterator[Any]:
    whole = defaults | own if isinstance(own, dict) else {}
    column = whole.get("split_by")
    if not isinstance(column, str) or "split_value" in own:
        yield own
        return
    data = _data(own, defaults)
    path = next(_found(data, base, folders, whole=True), None)
    if path is None:  # reported when the files are read
        yield own
        return
    where = f"experiment {own.get('id', '')!r}"
    groups = read_table(path, where, reading=_reading(whole)).tests(column, where)
    taken = {
        each.get("split_value")
        for each in others
        if isinstance(each, dict) and _data(each, defaults) == data
    }
    for value in groups:
        if value not in taken:
            yield own | {"split_by": column, "split_value": value, "id": _id(own, value)}


def _reading(section: Section) -> Reading:
    """Return a section's options for reading its file that have valid types."""
    kinds = {"encoding": str, "skip_rows": int, "decimal": str, "sheet": str}
    found: Section = {
        key: section[key] for key, kind in kinds.items() if isinstance(section.get(key), kind)
    }
    return Reading(**found)


def _id(own: Section, name: str) -> Any:
    given = own.get("id", "*")
    if not isinstance(given, str):
        return given
    return given.replace("*", name) if "*" in given else f"{given} {name}"
