"""Count figures of the maintainability of a code base.

    python scripts/code_figures.py [ROOT]

For the packages, with and without `closed_loop`: files, lines, lines of code (no docstrings,
imports, comments and blanks), the share of import lines, modules that are imported by exactly one
other, modules below 60 lines, duplicate file names, and circular imports. Also the functions and
files that a fit of the embedded example executes in Python.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

PACKAGES = ("cluster_est", "workers")
APART = ("cluster_est.closed_loop", "workers.core")
SMALL = 60
FIT = """
import sys
sys.path.insert(0, sys.argv[1])
import cluster_est as ce
problem = ce.read_problem(sys.argv[1] + "/configs/mass_spring_damper.toml")
fit, seen = ce.fit, set()
sys.setprofile(lambda frame, event, _: seen.add(frame.f_code) if event == "call" else None)
fit(problem)
sys.setprofile(None)
places = [sys.argv[1] + "/" + package for package in sys.argv[2:]]
own = [c for c in seen if c.co_filename.startswith(tuple(places)) and c.co_name[0] != "<"]
print(len(own), "functions in", len({code.co_filename for code in own}), "files")
"""
"""Program that prints the functions called by a fit, without functions called only by imports."""


def main() -> None:
    """Print the figures, a line each."""
    root = Path(sys.argv[1] if sys.argv[1:] else ".")
    modules = {_name(p, root): p for f in PACKAGES for p in sorted((root / f).rglob("*.py"))}
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in modules.items()}
    imports = {name: set(_imported(tree, modules)) - {name} for name, tree in trees.items()}
    _print("packages", modules, trees, imports, lambda _: True)
    _print("without loop and core", modules, trees, imports, lambda n: not n.startswith(APART))
    for folder in ("tests", "scripts"):
        texts = [p.read_text(encoding="utf-8") for p in (root / folder).rglob("*.py")]
        print(f"{folder}: {len(texts)} files, {sum(map(_lines, texts))} lines")
    print("circles:", *(sorted(each) for each in _circles(_at_once(trees, modules))))
    given = [sys.executable, "-P", "-c", FIT, str(root.resolve()), *PACKAGES]
    print("a fit executes", subprocess.run(given, capture_output=True, text=True).stdout.strip())


def _print(
    title: str,
    modules: dict[str, Path],
    trees: dict[str, ast.Module],
    imports: dict[str, set[str]],
    counts: Callable[[str], bool],
) -> None:
    chosen = [name for name in modules if counts(name)]
    texts = {name: modules[name].read_text(encoding="utf-8") for name in chosen}
    lines = sum(map(_lines, texts.values()))
    code = sum(len(_code(texts[name], trees[name])) for name in chosen)
    imported = sum(len(_import_lines(trees[name])) for name in chosen)
    plain = [name for name in chosen if modules[name].name != "__init__.py"]
    importers = Counter(other for found in imports.values() for other in found)
    names = Counter(modules[name].name for name in plain)
    print(f"{title}: {len(chosen)} files, {lines} lines, {code} of code")
    print(f"  {imported / lines:.1%} of the lines import")
    print(f"  {sum(importers[name] == 1 for name in plain)} modules that one other imports")
    print(f"  {sum(_lines(texts[name]) < SMALL for name in plain)} modules below {SMALL} lines")
    print(f"  {sum(n > 1 for n in names.values())} file names that stand twice or more")


def _name(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def _lines(text: str) -> int:
    return len(text.splitlines())


def _import_lines(tree: ast.Module) -> set[int]:
    found = [n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom)]
    return {line for n in found for line in range(n.lineno, (n.end_lineno or n.lineno) + 1)}


def _code(text: str, tree: ast.Module) -> list[str]:
    """Return the lines of code; a text that stands alone is a docstring."""
    left = _import_lines(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            left |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(text.splitlines(), 1)
    return [s for i, s in lines if i not in left and s.strip() and not s.lstrip().startswith("#")]


def _imported(tree: ast.AST, modules: dict[str, Path]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in modules:
            inside = [f"{node.module}.{each.name}" for each in node.names]
            yield from (name if name in modules else node.module for name in inside)
        elif isinstance(node, ast.Import):
            yield from (each.name for each in node.names if each.name in modules)


def _at_once(trees: dict[str, ast.Module], modules: dict[str, Path]) -> dict[str, set[str]]:
    """Return the modules that each module imports when it is imported itself."""
    return {
        name: {other for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)
               for other in _imported(node, modules)} - {name}
        for name, tree in trees.items()
    }  # fmt: skip


def _circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Return sets of modules that import each other, directly or not."""
    reached = {name: set(found) for name, found in graph.items()}
    for through in graph:
        for found in reached.values():
            if through in found:
                found |= reached[through]
    inside = [frozenset(o for o in found if name in reached[o]) for name, found in reached.items()]
    return [set(each) for each in set(inside) if each]


if __name__ == "__main__":
    main()
