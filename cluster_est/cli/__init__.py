"""The command line: arguments, commands, and everything that prints."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence

from cluster_est.cli.parent_process import address_space, end, run_in_child

__all__ = ["main", "run"]

LEAST_MEMORY = 2.2
"""GB, below which libraries fail in ways that nobody can foresee."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    from cluster_est.cli import entry_point

    return entry_point.main(arguments)


def run() -> None:
    """Run a command as a program: end with its exit code, whatever still runs in threads.

    What takes memory is loaded only where somebody can say why that failed.
    """
    run_in_child()
    if address_space() < LEAST_MEMORY:
        sys.stderr.write(
            f"cluster-est: {LEAST_MEMORY:g} GB of address space are needed to load the libraries, "
            f"but there are only {address_space():.3g} GB; raise the limit (ulimit -v)\n"
        )
        end(2)
    if address_space() < math.inf:  # where OpenBLAS cannot start threads, it interrupts the process
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from cluster_est.cli import entry_point

        entry_point.run()
    except KeyboardInterrupt:  # while that is loaded, or another one while the first is being said
        end(130, in_order=False)
