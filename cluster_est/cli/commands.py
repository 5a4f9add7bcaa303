"""Every command by its name."""

from __future__ import annotations

from argparse import Namespace
from importlib import import_module

from cluster_est.cli.arrow_start import start_arrow

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
