"""The command line: arguments, commands, and everything that prints."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cluster_est.cli.parent_process import end, run_in_child

__all__ = ["main", "run"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    from cluster_est.cli import entry_point

    return entry_point.main(arguments)


def run() -> None:
    """Run a command as a program: end with its exit code, whatever still runs in threads.

    What takes memory is loaded only where somebody can say why that failed.
    """
    run_in_child()
    try:
        try:
            from cluster_est.cli import entry_point
        except (ImportError, MemoryError, OSError) as error:
            sys.stderr.write(
                f"cluster-est: this installation cannot be loaded ({error or 'no memory left'}); "
                "install it again, or let it have more memory if that is limited (ulimit -v)\n"
            )
            end(2)
        entry_point.run()
    except KeyboardInterrupt:  # while that is loaded, or another one while the first is being said
        end(130, in_order=False)
