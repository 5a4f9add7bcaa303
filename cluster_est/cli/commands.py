"""Every command by its name.

Before a command is loaded, pyarrow makes its first array without pandas, which it would import
then, to know a column of pandas when it is given one. No command is, and where pandas is installed
this takes a quarter of a second. Whoever asks pyarrow for pandas later still gets it.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from types import ModuleType

from typing_extensions import override


class _WithoutPandas(MetaPathFinder):
    """Finds no pandas, and leaves everything else to others."""

    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError(fullname)


def start_arrow() -> None:
    """Have pyarrow make its first array while pandas cannot be found."""
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    finder = _WithoutPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)


COMMANDS = {
    "init": "first_config",
    "check": "preparation",
    "fit": "estimate",
    "close-loop": "estimate",
    "sensitivity": "estimate",
    "design": "next_experiment",
    "simulate": "simulation",
    "show": "inspection",
    "report": "inspection",
    "watch": "inspection",
    "export": "inspection",
    "sweep": "estimate",
    "replay": "inspection",
}
"""The module of `cluster_est.cli` in which each command is a function of its name."""


def run_command(options: Namespace) -> int:
    """Run the command that was asked for, and return its exit code.

    Its module is imported now: who shows a run need not wait for what a fit needs.
    """
    start_arrow()
    name: str = options.command
    module = import_module(f"cluster_est.cli.{COMMANDS[name]}")
    return int(getattr(module, name.replace("-", "_"))(options))
