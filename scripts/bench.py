"""Run a bench by its name, print its table, and add it to a history.

    python scripts/bench.py NAME [options] [--history FOLDER]
    python scripts/bench.py NAME --help
    python scripts/bench.py

Without a name, the benches are listed. With --history, the rows are added to FOLDER/NAME.parquet
with the date, the commit and the options of the run, so that figures of two days can be compared.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType

# The matrices are small, so threads would only wait. This must be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pyarrow as pa
import pyarrow.parquet as pq
from benches import Row, Value

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path(__file__).resolve().parent / "benches"
sys.path.append(str(ROOT / "tests"))  # some benches measure with the FMUs of the tests

WIDTH = 9
"""Smallest width of a column, in characters."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bench named on the command line."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    names = sorted(p.stem for p in FOLDER.glob("*.py") if p.stem not in ("__init__", "common"))
    if not words or words[0] not in names:
        for name in names:
            print(f"{name:20} {summary((FOLDER / f'{name}.py').read_text(encoding='utf-8'))}")
        return int(bool(words) and words[0] not in ("-h", "--help"))
    bench = importlib.import_module(f"benches.{words[0]}")
    options = make_parser(words[0], bench).parse_args(words[1:])
    rows = []
    for row in bench.rows(options):
        rows.append(row)
        print("\n".join(lines(row, rows[-2] if len(rows) > 1 else {})), flush=True)
    if options.history:
        keep(options.history, words[0], rows, options)
    return 0


def summary(text: str) -> str:
    """Return the first line of a module's docstring."""
    return text.removeprefix('"""').split("\n", 1)[0].removesuffix('"""')


def make_parser(name: str, bench: ModuleType) -> argparse.ArgumentParser:
    """Return the parser of a bench: its own options, and common options."""
    parser = argparse.ArgumentParser(
        prog=f"bench.py {name}",
        description=bench.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for option, default in bench.OPTIONS.items():
        flag = f"--{option.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, list):
            kind = type(default[0])
            words = f"default {' '.join(map(str, default))}"
            parser.add_argument(flag, nargs="+", type=kind, default=default, help=words)
        else:
            parser.add_argument(
                flag, type=type(default), default=default, help=f"default {default}"
            )
    parser.add_argument("--history", type=Path, help="folder of the tables of former runs")
    return parser


def lines(row: Row, before: Row) -> Iterable[str]:
    """Yield a row as text, after the column heads if these differ from the previous row."""
    texts = {head: text(value) for head, value in row.items()}
    widths = {head: max(WIDTH, len(head), len(texts[head])) for head in row}
    if list(row) != list(before):
        yield "  ".join(f"{head:{widths[head]}}" for head in row)
    yield "  ".join(f"{texts[head]:{widths[head]}}" for head in row)


def text(value: Value) -> str:
    """Return a value as text: numbers with four digits."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def keep(folder: Path, name: str, rows: Iterable[Row], options: argparse.Namespace) -> None:
    """Add rows to the history of a bench; columns may differ between runs."""
    known: Row = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "options": " ".join(f"{k}={v}" for k, v in vars(options).items() if k != "history"),
    }
    path = folder / f"{name}.parquet"
    tables = [pq.read_table(path)] if path.is_file() else []
    full: list[Row] = [{**known, **row} for row in rows]
    heads = dict.fromkeys(head for row in full for head in row)
    tables.append(pa.table({head: [row.get(head) for row in full] for head in heads}))
    folder.mkdir(parents=True, exist_ok=True)
    written = path.with_suffix(".new")
    pq.write_table(pa.concat_tables(tables, promote_options="permissive"), written)
    written.replace(path)


def commit() -> str:
    """Return the current commit, with a plus sign for modified files; "" without a repository."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
