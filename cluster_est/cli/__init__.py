"""The command line: arguments, commands, and everything that prints."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence

from cluster_est.cli.parent_process import address_space, end, run_in_child

__all__ = ["main", "run"]

LEAST_MEMORY = 2.2
"""Memory in GB below which libraries fail in unpredictable ways."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    from cluster_est.cli import entry_point

    return entry_point.main(arguments)


def run() -> None:
    """Run a command as a program, and end with its exit code even if threads are still running.

    Modules that need much memory are imported only where a failure can be reported.
    """
    run_in_child()
    if address_space() < LEAST_MEMORY:
        sys.stderr.write(
            f"cluster-est: {LEAST_MEMORY:g} GB of address space are needed to load the libraries, "
            f"but there are only {address_space():.3g} GB; raise the limit (ulimit -v)\n"
        )
        end(2)
    if address_space() < math.inf:  # OpenBLAS without memory for threads interrupts
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from cluster_est.cli import entry_point

        entry_point.run()
    except KeyboardInterrupt:  # during imports, or while an interrupt is reported
        end(130, in_order=False)
