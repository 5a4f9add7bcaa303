"""Processes that stand ready in milliseconds: the fork server's, seen from its client."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from workers.errors import ModelError
from workers.process.fork_server import FORK, FORK_FOR_EFFECTS
from workers.process.watch import SharedProgress

CAN_FORK = hasattr(os, "fork")
"""Whether this system has processes of this kind; Windows has not."""


class ForkClient:
    """Starts processes that serve an installation, and says how they ended.

    The process that forks them is started again if somebody has killed it.

    Parameters
    ----------
    installation
        What each process is given; see `workers.process.child.serve`.

    Attributes
    ----------
    progress
        What the process has done that was forked last; see `workers.kernels.fmi.progress`.

    Raises
    ------
    ModelError
        On a system that cannot fork.
    """

    def __init__(self, installation: tuple[Any, ...]) -> None:
        if not CAN_FORK:
            raise ModelError(
                "an FMU in a process of its own needs a system that can fork processes, as Linux "
                'and macOS can, but this one cannot; there is executor.name = "local", in this '
                "process"
            )
        self._installation = installation
        self._shared = SharedProgress()
        self.progress = self._shared.progress
        self._start()

    def fork(self, *, effects: bool = False) -> tuple[int, Connection]:
        """A new process: its id, and a connection to it.

        Parameters
        ----------
        effects
            Whether it will be asked for effects, which take half a second to import.

        Raises
        ------
        OSError
            If none can be started.
        """
        self.progress[:] = 0
        try:
            return self._fork(effects)
        except (EOFError, OSError):
            self._stop()
            self._start()
        try:
            return self._fork(effects)
        except EOFError as error:
            raise OSError("the process that should have started it has ended") from error

    def wait(self, process: int) -> int | None:
        """The exit code of a process that ends, or minus the signal that ended it.

        None if nobody knows.
        """
        try:
            self._orders.send(process)
            code: int = self._orders.recv()
        except (EOFError, OSError):
            return None
        return code

    def close(self) -> None:
        """End all processes. Again does nothing."""
        self._stop()
        self._shared.close()

    def _stop(self) -> None:
        if not self._orders.closed:
            self._orders.close()
            self._fork_server.wait()

    def _start(self) -> None:
        mine, theirs = socket.socketpair()
        passed = theirs.fileno(), self._shared.descriptor
        with theirs:
            self._fork_server = subprocess.Popen(
                [sys.executable, "-m", "workers.process.fork_server", *map(str, passed)],
                pass_fds=passed,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": _import_path(), "OPENBLAS_NUM_THREADS": "1"},
            )
        self._orders = Connection(mine.detach())
        with contextlib.suppress(OSError):  # it has ended already: the first fork will say so
            self._orders.send(self._installation)

    def _fork(self, effects: bool) -> tuple[int, Connection]:
        mine, theirs = socket.socketpair()
        try:
            with theirs:
                self._orders.send(FORK_FOR_EFFECTS if effects else FORK)
                reduction.send_handle(self._orders, theirs.fileno(), self._fork_server.pid)
                process: int = self._orders.recv()
        except BaseException:
            mine.close()
            raise
        return process, Connection(mine.detach())


def _import_path() -> str:
    """Return the import path of this package, for the process to find it too."""
    own = str(Path(__file__).parents[2])
    return os.pathsep.join([own, *filter(None, [os.environ.get("PYTHONPATH")])])
