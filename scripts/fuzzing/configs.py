"""Configs with keys dropped, renamed and given other values, and with damaged text."""

from __future__ import annotations

import copy
import functools
import tomllib
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from cluster_est.toml import to_toml
from fuzzing.base import COMMANDS, CONFIGS, DATE, NUMBERS, TEXTS, VALUES, Input, damaged

FULL = Path(__file__).parent / "full.toml"
PATHS = [FULL, *sorted(CONFIGS.glob("*.toml"))]
OFTEN = [FULL, FULL, CONFIGS / "mass_spring_damper.toml", CONFIGS / "reference.toml"]
"""Their data are in this repository."""
LINES = [
    b'[parameters."a.b"]', b"m = {", b"[[experiments]]", b"[model]", b"x = 0x", b"a.b.c = 1",
    b"y = '''", b"\xff\xfe", b"z = 99-99-99", b"experiments = []", b"\x00", b"[" * 2000,
    b"deep = " + b"[" * 500 + b"]" * 500, b"long = " + b"9" * 5000, b"# \xe9", b"\xef\xbb\xbf",
]  # fmt: skip


@functools.cache
def _tree(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text(encoding="utf-8"))


@st.composite
def configs(draw: st.DrawFn) -> Input:
    """A config of this project, spoiled in up to three places."""
    tree = copy.deepcopy(_tree(draw(st.sampled_from([*PATHS, *OFTEN * 4]))))
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 2, 3]))):
        _spoil(draw, tree)
    content = to_toml(tree).replace(f'"{DATE}"', DATE).encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 5)) == 0:
        content = _damaged_text(draw, content)
    return Input("config", draw(COMMANDS), (("config.toml", content),))


def _spoil(draw: st.DrawFn, tree: Any) -> None:
    """Change something: at this level, or further down."""
    while True:
        keys = sorted(tree) if isinstance(tree, dict) else list(range(len(tree)))
        if not keys:
            return
        key = draw(st.sampled_from(keys))
        if not isinstance(tree[key], dict | list) or draw(st.integers(0, 3)) == 0:
            break
        tree = tree[key]
    action = draw(st.sampled_from([*["alike", "retype"] * 3, "drop", "rename", "add", "repeat"]))
    if action == "drop":
        del tree[key]
    elif action == "retype":
        tree[key] = draw(VALUES)
    elif action == "alike":
        tree[key] = draw(_alike(tree[key]))
    elif isinstance(tree, list):
        tree.append(copy.deepcopy(tree[key]))
    elif action == "add":
        tree[draw(st.text(max_size=4))] = draw(VALUES)
    else:
        other = key[:-1] if action == "rename" else draw(st.sampled_from(sorted(tree)))
        tree[other] = copy.deepcopy(tree[key])


def _alike(value: Any) -> st.SearchStrategy[Any]:
    """Values of the same type, which reach further."""
    if isinstance(value, str):
        return TEXTS
    if isinstance(value, list):
        return st.lists(NUMBERS, max_size=3)
    return VALUES if isinstance(value, dict) else NUMBERS


def _damaged_text(draw: st.DrawFn, content: bytes) -> bytes:
    how = draw(st.sampled_from(["bytes", "line", "encoding"]))
    if how == "bytes":
        return damaged(draw, content)
    if how == "encoding":
        text = content.decode("utf-8", "replace")
        return text.encode(draw(st.sampled_from(["utf-16", "utf-8-sig", "utf-32", "utf-7"])))
    lines = content.split(b"\n")
    lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from([*LINES, *lines])))
    return b"\n".join(lines)
