"""Processes that stand ready in milliseconds: the fork server's, seen from its client."""

from __future__ import annotations

import contextlib
import os
import socket
from multiprocessing import reduction
from multiprocessing.connection import Connection

from workers.errors import ModelError
from workers.process.orders import END, FORK, FORK_FOR_EFFECTS, Installation
from workers.process.template_client import TEMPLATE
from workers.process.watch import SharedProgress

CAN_FORK = hasattr(os, "fork")
"""Whether this system has processes of this kind; Windows has not."""


class ForkClient:
    """Starts processes that serve an installation, and says how they ended.

    The process that forks them is started with the first, and again if somebody has killed it.

    Parameters
    ----------
    installation
        What each process is given; see `workers.process.fork_server.serve`.

    Attributes
    ----------
    progress
        What the process has done that was forked last; see `workers.messages.types`.
    server
        The id of the process that forks them; 0 before the first.

    Raises
    ------
    ModelError
        On a system that cannot fork.
    """

    def __init__(self, installation: Installation) -> None:
        if not CAN_FORK:
            raise ModelError(
                "an FMU in a process of its own needs a system that can fork processes, as Linux "
                'and macOS can, but this one cannot; there is executor.name = "local", in this '
                "process"
            )
        self._installation = installation
        self._shared = SharedProgress()
        self._orders: Connection | None = None
        self.progress = self._shared.progress
        self.server = 0

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
        with contextlib.suppress(EOFError, OSError):
            return self._fork(effects)
        try:
            return self._fork(effects)
        except EOFError as error:
            raise OSError("the process that should have started it has ended") from error

    def wait(self, process: int) -> int | None:
        """The exit code of a process that ends, or minus the signal that ended it.

        None if nobody knows.
        """
        if self._orders is None:
            return None
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

    def _fork(self, effects: bool) -> tuple[int, Connection]:
        orders = self._orders = self._orders or self._start()
        mine, theirs = socket.socketpair()
        try:
            with theirs:
                orders.send(FORK_FOR_EFFECTS if effects else FORK)
                reduction.send_handle(orders, theirs.fileno(), self.server)
                process: int = orders.recv()
        except BaseException:  # what it would answer is nobody's any more
            mine.close()
            self._stop()
            raise
        return process, Connection(mine.detach())

    def _start(self) -> Connection:
        mine, theirs = socket.socketpair()
        with theirs, contextlib.ExitStack() as unless_started:
            unless_started.callback(mine.close)
            passed = theirs.fileno(), self._shared.descriptor
            self.server = TEMPLATE.fork_server(self._installation, *passed)
            unless_started.pop_all()
        return Connection(mine.detach())

    def _stop(self) -> None:
        """End the fork server, and wait until it is gone and has ended all that it forked."""
        if self._orders is None:
            return
        with self._orders as orders, contextlib.suppress(EOFError, OSError):
            orders.send(END)
            while True:
                orders.recv()
        self._orders = None
