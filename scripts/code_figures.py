"""Count what makes a code base easy or hard to find one's way in.

    python scripts/code_figures.py [FOLDER ...]

Without folders: the packages of this project. Printed are the widest folder, files at the root of
the first package, long files, lengths of functions, functions with many arguments, class names that
stand more than once, class names of a single word, and docstrings that begin with a question word.
"""

from __future__ import annotations

import ast
import re
import statistics
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGES = ("cluster_est", "workers")
LONG_FILE = 300
MANY_ARGUMENTS = 8
QUESTION_WORDS = {"What", "Whether", "How", "Where", "Which"}


def main() -> None:
    """Print the figures, a line each."""
    folders = [Path(each) for each in sys.argv[1:] or PACKAGES]
    files = [p for folder in folders for p in sorted(folder.rglob("*.py"))]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}
    widths = Counter(path.parent for path in files)
    print("files", len(files), " lines", sum(_lines(path) for path in files))
    widest = ", ".join(f"{folder} {count}" for folder, count in widths.most_common(5))
    print("widest folders:", widest)
    print(f"files at the root of {folders[0]}:", widths[folders[0]])
    long = sorted((_lines(p), str(p)) for p in files if _lines(p) > LONG_FILE)
    print(f"files over {LONG_FILE} lines:", len(long), *(f"{p} {n}" for n, p in reversed(long)))
    _functions(trees)
    _classes(trees)
    _docstrings(trees)


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def _functions(trees: dict[Path, ast.Module]) -> None:
    found = [node for tree in trees.values() for node in _of(tree, ast.FunctionDef)]
    lengths = sorted((f.end_lineno or f.lineno) - f.lineno + 1 for f in found)
    tenth = lengths[int(0.9 * len(lengths))]
    print(f"functions: {len(found)}, lines: median {statistics.median(lengths):g}, 90 % {tenth}")
    wide = [f.name for f in found if _arguments(f) >= MANY_ARGUMENTS]
    print(f"functions with {MANY_ARGUMENTS} or more arguments: {len(wide)}")


def _arguments(function: ast.FunctionDef) -> int:
    given = function.args
    return len([a for a in (*given.posonlyargs, *given.args, *given.kwonlyargs) if a.arg != "self"])


def _classes(trees: dict[Path, ast.Module]) -> None:
    names = Counter(node.name for tree in trees.values() for node in _of(tree, ast.ClassDef))
    twice = sorted(name for name, count in names.items() if count > 1)
    print("class names that stand twice or more:", len(twice), *twice)
    words = [len(re.findall(r"[A-Z][a-z0-9]*", name.lstrip("_"))) for name in names]
    single = sum(count == 1 for count in words)
    print(f"class names of one word: {single} of {len(names)}, {100 * single / len(names):.0f} %")


def _docstrings(trees: dict[Path, ast.Module]) -> None:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    texts = [ast.get_docstring(n) for tree in trees.values() for n in _of(tree, *documented)]
    known = [text for text in texts if text]
    asking = sum(text.split()[0] in QUESTION_WORDS for text in known)
    share = 100 * asking / len(known)
    print(f"docstrings that begin with a question word: {asking} of {len(known)}, {share:.0f} %")


def _of(tree: ast.AST, *kinds: type[ast.AST]) -> Iterator:  # type: ignore[type-arg]
    return (node for node in ast.walk(tree) if isinstance(node, kinds))


if __name__ == "__main__":
    main()
