"""Inputs of all kinds: spoiled configs, tables and FMUs.

Configs have keys dropped, renamed and given other values, and damaged text; measured tables have
wrong columns, types, times and bytes, in every format.
"""

from __future__ import annotations

import copy
import datetime
import decimal
import functools
import io
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st
from pyarrow import feather
from scipy.io import savemat
from scipy.sparse import csc_array

from cluster_est.toml import to_toml
from fuzzing.base import COMMANDS, CONFIGS, DATE, NUMBERS, TEXTS, VALUES, Input, damaged
from fuzzing.fmus import archives, descriptions

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


CONFIG = """
model.fmu = "models/mass_spring_damper.fmu"
parameters.m = {{ start = 1.0, bounds = [0.1, 10.0] }}
parameters.k = {{ start = 25.0, bounds = [1.0, 200.0], scale = "log" }}
values.c = 0.6

[[experiments]]
id = "a"
data = "{data}"
{extra}
inputs.F = {{ column = "force", interpolation = "{hold}" }}
outputs.y = "position"
"""
EXTRAS = [
    'time = "time"', 'time = "time"', "sample_time = 0.1", 'time = "time"\nrows = [1, 3]',
    'time = "time"\ncolumns.force = { factor = 1e300, demean = true }',
    'time = "time"\ncurve = { columns = { x = "position", F = "force" } }',
    'time = "time"\nwarm_up = 0.2', 'time = "time"\nstop = 0.25',
    'time = "time"\nwindows = [[0, 1]]', 'time = "position"', 'time = "force"',
]  # fmt: skip
ROWS = {
    "time": [0.0, 0.1, 0.2, 0.3, 0.4], "force": [1.0, 1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.01, 0.02, 0.01, 0.0],
}  # fmt: skip
_CELLS = [
    "", "nan", "inf", "-inf", "1e999", "-1e308", "0", "0.1", "x", "1,5", "1_000", "0x10", "true",
    "9" * 400, "1e-320", "2020-01-01", "\u0661", "\u00a01", '"', '"0.3', "\x00", "\u2212 1",
    "a" * 70000,
]  # fmt: skip
CELLS = st.sampled_from(_CELLS)
COLUMNS: list[Any] = [
    [], [1], [None] * 5, ["0", "0.1", "0.2", "0.3", "x"], [True, False] * 2 + [None],
    [float("nan")] * 5, [1e308] * 5, [0.0, 0.1, 0.1, 0.3, 0.4], [0.4, 0.3, 0.2, 0.1, 0.0],
    [2**62, 1, 2, 3, 4], [b"a"] * 5, [[1.0], [2.0], [], None, [3.0]], [{"a": 1}] * 5,
    [datetime.datetime(2020, 1, 1)] * 5, [datetime.date(2020, 1, 1)] * 5,
    [datetime.timedelta(seconds=i) for i in range(5)], [decimal.Decimal("0.1")] * 5,
    np.arange(5, dtype=np.float16), np.arange(5, dtype=np.uint64) + 2**63,
    pa.array(list("01234")).dictionary_encode(), pa.array([1.0] * 5).dictionary_encode(),
    pa.array(list("01234"), pa.string_view()), pa.array([0, 1, 2, 3, 4], pa.time64("us")),
    pa.array(list("01234"), pa.large_string()), pa.nulls(5),
    pa.ListArray.from_arrays([0, 1, 2, 3, 4, 5], pa.array([1.0] * 5)),
    pa.RunEndEncodedArray.from_arrays([5], [1.0]),
]  # fmt: skip
VARIABLES: list[Any] = [
    np.zeros((2, 2)), np.zeros((0, 0)), np.array(1.0), np.arange(5) + 1j, np.array(["a", "b"]),
    np.array([1, "a"], object), {"inner": np.arange(5)}, csc_array(np.eye(5)), "text",
    np.arange(5, dtype=np.int8), np.arange(5, dtype=np.uint64), np.zeros((5, 1, 1)),
    np.full(5, np.nan), np.array([True] * 5), np.arange(5.0)[::-1],
]  # fmt: skip


@st.composite
def tables(draw: st.DrawFn) -> Input:
    """A valid config, and the table that it names, spoiled."""
    kinds = [("csv", _csv), ("csv", _csv), ("parquet", _parquet), ("feather", _feather)]
    ending, make = draw(st.sampled_from([*kinds, ("mat", _mat)]))
    content = make(draw)
    if draw(st.integers(0, 3)) == 0:
        content = damaged(draw, content)
    if draw(st.integers(0, 19)) == 0:
        ending = draw(
            st.sampled_from(["csv", "parquet", "feather", "mat", "arrow", "tsv", "xlsx", "CSV"])
        )
    hold = draw(st.sampled_from(["linear", "hold"]))
    config = CONFIG.format(data=f"a.{ending}", extra=draw(st.sampled_from(EXTRAS)), hold=hold)
    files = (("config.toml", config.encode()), (f"a.{ending}", content))
    return Input("table", draw(COMMANDS), files)


def _csv(draw: st.DrawFn) -> bytes:
    lines = [list(ROWS), *([repr(v) for v in row] for row in zip(*ROWS.values(), strict=True))]
    for _ in range(draw(st.integers(0, 3))):
        row = draw(st.integers(0, len(lines) - 1))
        action = draw(st.sampled_from(["cell", "cell", "drop row", "repeat row", "drop", "add"]))
        if action == "cell" and lines[row]:
            lines[row][draw(st.integers(0, len(lines[row]) - 1))] = draw(CELLS)
        elif action == "drop row" and len(lines) > 1:
            del lines[row]
        elif action == "repeat row":
            lines.insert(row, list(lines[row]))
        elif action == "drop":
            del lines[row][-1:]
        else:
            lines[row].append(draw(CELLS))
    comma = draw(st.sampled_from([",", ",", ",", ";", "\t", "|", ", "]))
    end = draw(st.sampled_from(["\n", "\n", "\r\n", "\r", "\n\n"]))
    text = end.join(comma.join(cells) for cells in lines) + draw(st.sampled_from(["", end]))
    encodings = ["utf-8"] * 6 + ["utf-8-sig", "utf-16", "cp1252", "utf-16-le"]
    return text.encode(draw(st.sampled_from(encodings)), "replace")


def _table(draw: st.DrawFn) -> pa.Table:
    """Columns that may be of any type, be missing or be there twice."""
    columns: list[tuple[str, Any]] = list(ROWS.items())
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(columns) - 1))
        column = pa.array(draw(st.sampled_from(COLUMNS)))
        name = draw(st.sampled_from([columns[at][0], columns[at][0], "time", " time ", "", "\n"]))
        if draw(st.integers(0, 4)) == 0:
            columns.append((name, column))
        else:
            columns[at] = name, column
    arrays = [pa.array(column) for _, column in columns]
    length = min(map(len, arrays))
    return pa.Table.from_arrays([a.slice(0, length) for a in arrays], [name for name, _ in columns])


def _parquet(draw: st.DrawFn) -> bytes:
    packed = io.BytesIO()
    try:
        pq.write_table(_table(draw), packed)
    except pa.ArrowException:  # a type that Parquet lacks
        pq.write_table(pa.table(ROWS), packed)
    return packed.getvalue()


def _feather(draw: st.DrawFn) -> bytes:
    packed = io.BytesIO()
    compression = draw(st.sampled_from(["uncompressed", "lz4", "zstd"]))
    try:
        feather.write_feather(_table(draw), packed, compression)
    except (pa.ArrowException, ValueError):
        feather.write_feather(pa.table(ROWS), packed)
    return packed.getvalue()


def _mat(draw: st.DrawFn) -> bytes:
    variables: dict[str, Any] = {name: np.array(values) for name, values in ROWS.items()}
    for _ in range(draw(st.integers(0, 2))):
        name = draw(st.sampled_from([*ROWS, "other"]))
        variables[name] = draw(st.sampled_from(VARIABLES))
    packed = io.BytesIO()
    plain = draw(st.booleans())
    try:
        savemat(
            packed,
            variables,
            format="4" if draw(st.integers(0, 5)) == 0 else "5",
            do_compression=plain,
        )
    except (TypeError, ValueError):  # what version 4 lacks
        savemat(packed, {name: np.array(values) for name, values in ROWS.items()})
    return packed.getvalue()


INPUTS = st.one_of(configs(), configs(), tables(), descriptions(), archives())
