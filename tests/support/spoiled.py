"""A small valid input, and the means to spoil it."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fmpy import read_model_description
from support.problems.springs import FMU

from cluster_est.toml import to_toml

REMOVED = object()
NAN, INF = float("nan"), float("inf")
ROWS = "time,force,position\n0,1,0\n0.1,1,0.01\n0.2,0,0.02\n0.3,0,0.01\n"
XML = "modelDescription.xml"
LIBRARY = "binaries/linux64/mass_spring_damper.so"
GUID: str = read_model_description(FMU).guid
MASS = '<Real unit="kg" min="0.0" start="1.0" />'


def valid_tree() -> dict[str, Any]:
    """The config that goes with ROWS."""
    record = {"id": "a", "data": "a.csv", "time": "time"}
    return {
        "model": {"fmu": str(FMU)},
        "parameters": {
            "m": {"start": 1.0, "bounds": [0.1, 10.0]},
            "k": {"start": 25.0, "bounds": [1.0, 200.0], "scale": "log"},
        },
        "values": {"c": 0.6},
        "experiments": [record | {"inputs": {"F": "force"}, "outputs": {"y": "position"}}],
        "method": {"options": {"max_iterations": 1}},
    }


def spoiled_tree(changes: dict[str, Any]) -> dict[str, Any]:
    """The valid config with values put in, or REMOVED, at paths like "experiments.0.id"."""
    tree = valid_tree()
    for path, value in changes.items():
        *parents, last = path.split(".")
        target: Any = tree
        for part in parents:
            target = target[int(part)] if isinstance(target, list) else target.setdefault(part, {})
        if value is REMOVED:
            del target[last]
        elif isinstance(target, list):
            target[int(last)] = value
        else:
            target[last] = value
    return tree


def write_input(
    folder: Path, changes: dict[str, Any] | None = None, rows: str | bytes = ROWS
) -> Path:
    """Write a.csv and config.toml and give the config's path."""
    (folder / "a.csv").write_bytes(rows.encode() if isinstance(rows, str) else rows)
    path = folder / "config.toml"
    path.write_text(to_toml(spoiled_tree(changes or {})), encoding="utf-8")
    return path


def spoiled_fmu(
    change: Callable[[dict[str, bytes]], object] | None = None, xml: dict[str, str] | None = None
) -> bytes:
    """The mass-spring-damper with other entries, or with texts in its description replaced."""
    with zipfile.ZipFile(FMU) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    for old, new in (xml or {}).items():
        assert old.encode() in entries[XML], old
        entries[XML] = entries[XML].replace(old.encode(), new.encode())
    if change is not None:
        change(entries)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return packed.getvalue()


def rename(old: str, new: str) -> Callable[[dict[str, bytes]], None]:
    """Rename every entry of an FMU that starts so."""

    def change(entries: dict[str, bytes]) -> None:
        for name in [n for n in entries if n.startswith(old)]:
            entries[new + name.removeprefix(old)] = entries.pop(name)

    return change
