"""Measure what tests protect: change one thing at a time in a module, and see whether they fail.

A mutant differs from the module in one comparison, operator, number, condition, filter or call.
Mutants that no test detects are printed as survived. Some change nothing (a slightly wider
tolerance), the others reveal gaps (R. A. DeMillo, R. J. Lipton, F. G. Sayward,
Computer 11(4) (1978) 34-41, doi:10.1109/C-M.1978.218136)::

    python scripts/mutants.py cluster_est/executors/log_replay.py tests/unit/cluster_est/executors
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAIRS: tuple[tuple[type[ast.AST], type[ast.AST]], ...] = (
    (ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot),
    (ast.In, ast.NotIn), (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or),
)  # fmt: skip
SWAPPED = dict(PAIRS) | {b: a for a, b in PAIRS} | {ast.Pow: ast.Mult}
SECONDS = 1200.0
"""Seconds after which tests count as failed, because a mutant may not terminate."""


def _swap(node: ast.AST, name: str) -> None:
    """Replace an operator by its opposite."""
    operator = getattr(node, name)
    setattr(node, name, SWAPPED[type(operator)]())


def mutants(tree: ast.Module) -> Iterator[int]:
    """Yield the line of each possible change, while the module is changed."""
    ignored: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST] = []
        if isinstance(node, ast.FunctionDef):
            arguments = [*node.args.args, *node.args.kwonlyargs]
            parts = [*node.decorator_list, *(a.annotation for a in arguments if a.annotation)]
            parts += [node.returns] if node.returns else []
        elif isinstance(node, ast.ClassDef):
            parts = [*node.decorator_list]
        elif isinstance(node, ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.JoinedStr):
            parts = [node]
        ignored |= {id(each) for part in parts for each in ast.walk(part)}
    for node in list(ast.walk(tree)):
        if id(node) not in ignored:
            yield from _changes(node)


def _changes(node: ast.AST) -> Iterator[int]:
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in SWAPPED:
            node.ops = [SWAPPED[type(operator)]()]  # type: ignore[list-item]
            yield node.lineno
            node.ops = [operator]
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) | ast.BoolOp(op=operator) if (
            type(operator) in SWAPPED
        ):
            _swap(node, "op")
            yield node.lineno
            node.op = operator
        case ast.Constant(value=bool() | int() | float() as value):
            node.value = not value if isinstance(value, bool) else 2 * value if value else 1
            yield node.lineno
            node.value = value
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            node.test = ast.UnaryOp(ast.Not(), test)
            yield node.lineno
            node.test = test
        case ast.comprehension(ifs=[_, *rest] as conditions):
            node.ifs = rest
            yield node.iter.lineno
            node.ifs = conditions
        case ast.Expr(value=ast.Call() as call):
            node.value = ast.Constant(None)
            yield node.lineno
            node.value = call


def notice(tests: list[str]) -> bool:
    """Return whether any of the tests fails."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    try:
        ended = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, timeout=SECONDS
        )
    except subprocess.TimeoutExpired:
        return True
    return ended.returncode != 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("tests", nargs="+", help="files, folders and options of pytest")
    parser.add_argument("--count", type=int, default=10, help="mutants, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    options, pytest_options = parser.parse_known_args()
    tests = [*options.tests, *pytest_options]
    path = options.file.resolve()
    source = path.read_text(encoding="utf-8")
    if notice(tests):
        sys.exit("the tests fail as it is; correct that first")
    tree = ast.parse(source)
    before = ast.unparse(tree)
    changed = [(line, ast.unparse(ast.fix_missing_locations(tree))) for line in mutants(tree)]
    drawn = random.Random(options.seed).sample(changed, min(options.count, len(changed)))
    noticed = 0
    try:
        for line, text in sorted(drawn):
            path.write_text(text + "\n", encoding="utf-8")
            found = notice(tests)
            noticed += found
            pairs = zip(before.splitlines(), text.splitlines(), strict=False)
            new = next((b.strip() for a, b in pairs if a != b), "")
            print("noticed " if found else "SURVIVED", f"line {line}: {new}", flush=True)
    finally:
        path.write_text(source, encoding="utf-8")
    print(f"{noticed} of {len(drawn)} noticed")


if __name__ == "__main__":
    main()
