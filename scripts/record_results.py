"""Record what every shipped config computes, and compare two such records bit by bit.

For changes that must not change results: record before and after, then compare.

    python scripts/record_results.py record before
    python scripts/record_results.py record after
    python scripts/record_results.py compare before after

A record holds the run folders of a fit and a simulation of every config in `configs/`, of the
closed loops of those with `[closed_loop]` or measured data, of the sweep, of a fit that was stopped
and resumed, of fits in processes and with Ray, and the exports of a fit and of a closed loop.
Measured data is found as the configs say; what needs data that is not there is named and left out.

Compared are all columns of all tables, run.json, the resolved config and every file of an exported
archive. Clocks and names of workers are left out: see `CLOCKS`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

CONFIGS = Path("configs")
COMMAND = [sys.executable, "-c", "from cluster_est.cli import run; run()"]
CLOCKS = {
    "seconds",
    "busy_seconds",
    "search_seconds",
    "started",
    "ended",
    "worker",
    "config_folder",
    "pool",
    "time_stamp",
}
"""Columns and keys with times, paths, or names of workers."""
SKIPPED = {"report.html", "workers.parquet"}
LOG_ORDER = ("search", "evaluation", "experiment", "purpose", "want")
TABLES = {".parquet", ".arrow", ".feather"}


def main() -> int:
    """Record or compare, according to the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    actions = parser.add_subparsers(dest="action", required=True)
    record = actions.add_parser("record")
    record.add_argument("folder", type=Path)
    record.add_argument("--only", default="", help="cases whose names contain this")
    compare = actions.add_parser("compare")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.action == "record":
        return record_all(options.folder, options.only)
    return compare_all(options.before, options.after)


def cases() -> Iterator[tuple[str, list[list[str]]]]:
    """Yield a name, and the commands whose outputs are recorded; OUT is the case's folder."""
    for config in sorted(CONFIGS.glob("*.toml")):
        if config.stem == "sweep":
            continue
        path = str(config)
        small = ["budget.evaluations=400"] if config.stem in ("emps", "silverbox") else []
        yield f"fit/{config.stem}", [["fit", path, *small, "--out", "OUT/run", "--no-report"]]
        yield f"simulate/{config.stem}", [["simulate", path, "--out", "OUT/table.parquet"]]
    for name in ("cascaded_tanks", "emps", "silverbox", "mass_spring_damper"):
        path = str(CONFIGS / f"{name}.toml")
        yield f"loop/{name}", [["close-loop", path, "--out", "OUT/run", "--no-report"]]
    yield (
        "sensitivity",
        [["sensitivity", str(CONFIGS / "mass_spring_damper.toml"), "--out", "OUT/run"]],
    )
    yield "sweep", [["sweep", str(CONFIGS / "sweep.toml"), "--out", "OUT/sweep"]]
    spring = str(CONFIGS / "mass_spring_damper.toml")
    for executor in ("processes", "ray"):
        where = [f"executor.name={executor}", "executor.workers=2"]
        yield (
            f"executor/{executor}",
            [["fit", spring, *where, "multistart.n=4", "--out", "OUT/run", "--no-report"]],
        )
    intervals = ['uncertainty.profiles=["all"]', "uncertainty.bootstrap=20"]
    intervals += ["experiments.exp4.role=train"]  # a bootstrap needs at least five
    yield "uncertainty", [["fit", spring, *intervals, "--out", "OUT/run", "--no-report"]]
    for method in METHODS:
        chosen = [f"method.name={method}", "budget.evaluations=300"]
        chosen += ["method.options.bounds=enforce"] if method == "nelder_mead" else []
        yield f"method/{method}", [["fit", spring, *chosen, "--out", "OUT/run", "--no-report"]]
    yield (
        "resume",
        [
            ["fit", spring, "budget.evaluations=12", "--out", "OUT/run", "--no-report"],
            ["fit", spring, "--out", "OUT/run", "--resume", "--no-report"],
        ],
    )
    yield (
        "export/fit",
        [
            ["fit", spring, "--out", "OUT/run", "--no-report"],
            ["export", "OUT/run", "--experiment", "exp1", "--fmu", "OUT/fit.fmu"],
            ["export", "OUT/run", "--experiment", "exp1", "--ssv", "OUT/fit.ssv", "--text"],
        ],
    )
    tanks = str(CONFIGS / "cascaded_tanks.toml")
    yield (
        "export/loop",
        [
            ["close-loop", tanks, "closed_loop.max_effects=1", "--out", "OUT/run", "--no-report"],
            ["export", "OUT/run", "--fmu", "OUT/loop.fmu", "--ssv", "OUT/loop.ssv", "--text"],
            ["export", "OUT/run", "--modelica"],
            ["show", "OUT/run"],
        ],
    )


METHODS = (
    "sqp",
    "nelder_mead",
    "pattern_search",
    "de",
    "cmaes",
    "pso",
    "ga",
    "isres",
    "scipy_least_squares",
)


def record_all(folder: Path, only: str) -> int:
    """Run every case in its own folder, with its output."""
    shared = Path.cwd().parent / "shared" / "data"
    environment = {"CLUSTER_EST_DATA": str(shared)} | dict(os.environ) | {"COLUMNS": "120"}
    failed = 0
    for name, commands in cases():
        if only not in name:
            continue
        out = folder / name
        out.mkdir(parents=True)
        for i, command in enumerate(commands):
            filled = [each.replace("OUT", str(out)) for each in command]
            done = subprocess.run(
                [*COMMAND, *filled], env=environment, capture_output=True, text=True, check=False
            )
            if command[0] == "export":
                (out / f"printed {i}.txt").write_text(done.stdout, encoding="utf-8")
            if done.returncode not in (0, 1):
                failed += 1
            last = done.stderr.strip().splitlines()[-1:] if done.returncode else []
            print(name, command[0], "exit code", done.returncode, *last, flush=True)
    return 1 if failed else 0


def compare_all(before: Path, after: Path) -> int:
    """Print every file, column or key that differs; return 1 if there is a difference."""
    wrong = 0
    names = sorted(
        {_name(p, before) for p in _files(before)} | {_name(p, after) for p in _files(after)}
    )
    compared = 0
    for name in names:
        one, other = before / name, after / name
        if not one.is_file() or not other.is_file():
            found = ["only before" if one.is_file() else "only after"]
        else:
            compared += 1
            found = list(_differences(one, other))
        for line in found:
            wrong += 1
            print(f"{name}: {line}")
    print(f"{compared} files compared, {wrong} differences")
    return 1 if wrong else 0


def _files(folder: Path) -> list[Path]:
    kept = TABLES | {".json", ".toml", ".txt", ".fmu", ".ssv"}
    return [
        p
        for p in folder.rglob("*")
        if p.is_file() and p.name not in SKIPPED and not p.name.startswith(".") and p.suffix in kept
    ]


def _name(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder))


def _differences(one: Path, other: Path) -> Iterator[str]:
    if one.suffix in TABLES:
        tables = [_read(p) for p in (one, other)]
        if one.parent.name == "evaluations":  # a log, in the order of the answers
            tables = [t.sort_by([(key, "ascending") for key in LOG_ORDER]) for t in tables]
        yield from _table_differences(tables[0], tables[1])
    elif one.suffix == ".json":
        trees = [json.loads(p.read_text(encoding="utf-8")) for p in (one, other)]
        yield from _tree_differences(trees[0], trees[1], "")
    elif one.suffix == ".toml":
        trees = [tomllib.loads(p.read_text(encoding="utf-8")) for p in (one, other)]
        yield from _tree_differences(trees[0], trees[1], "")
    elif one.suffix == ".fmu":
        with zipfile.ZipFile(one) as first, zipfile.ZipFile(other) as second:
            yield from _archive_differences(first, second)
    elif one.read_bytes() != other.read_bytes():
        yield "other bytes"


def _read(path: Path) -> pa.Table:
    if path.suffix == ".parquet":
        return pq.read_table(path)
    with pa.ipc.open_stream(path) as stream:
        return stream.read_all()


def _table_differences(one: pa.Table, other: pa.Table) -> Iterator[str]:
    for column in dict.fromkeys([*one.column_names, *other.column_names]):
        if column in CLOCKS:
            continue
        if column not in one.column_names or column not in other.column_names:
            yield f"column {column} is only {'before' if column in one.column_names else 'after'}"
        elif _bytes(one[column]) != _bytes(other[column]):
            pairs = zip(one[column].to_pylist(), other[column].to_pylist(), strict=False)
            first = next((pair for pair in pairs if repr(pair[0]) != repr(pair[1])), None)
            yield f"column {column}: {len(one)} and {len(other)} rows, first {first!s:.160}"


def _bytes(column: pa.ChunkedArray) -> bytes:
    """Return type and values of a column, independent of its chunks."""
    table = pa.table({"column": column.combine_chunks()}).replace_schema_metadata(None)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(pa.Table.from_pylist(table.to_pylist(), schema=table.schema))
    return bytes(sink.getvalue())


def _tree_differences(one: Any, other: Any, path: str) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in dict.fromkeys([*one, *other]):
            if key not in CLOCKS:
                yield from _tree_differences(one.get(key), other.get(key), f"{path}.{key}")
    elif repr(one) != repr(other):
        yield f"{path.lstrip('.')} was {one!s:.80} and is {other!s:.80}"


def _archive_differences(one: zipfile.ZipFile, other: zipfile.ZipFile) -> Iterator[str]:
    names = dict.fromkeys([*one.namelist(), *other.namelist()])
    for name in names:
        if name not in one.namelist() or name not in other.namelist():
            yield f"{name} stands in one only"
        elif one.read(name) != other.read(name):
            yield f"{name}: other bytes"


if __name__ == "__main__":
    sys.exit(main())
