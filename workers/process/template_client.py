"""Fork servers from the template process, seen from the program that wants them."""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path

from workers.fmu.surroundings import READ_AT_START
from workers.process.orders import Installation, StartOrder


class TemplateClient:
    """The template process of this program.

    It is started when it is needed first, and again if somebody has killed it or an environment
    variable has changed that it could only read when it started.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: Connection | None = None
        self._read_at_start: dict[str, str] = {}

    def fork_server(self, installation: Installation, orders: int, progress: int) -> int:
        """Start a fork server.

        Parameters
        ----------
        installation
            What its processes make their evaluators of.
        orders
            Descriptor of the connection that it takes its orders from.
        progress
            Descriptor of the memory that its processes note their progress in.

        Returns
        -------
        int
            The id of its process.

        Raises
        ------
        OSError
            If none can be started.
        """
        order = StartOrder(installation, _environment(installation[0].environment), _folder())
        with self._lock, _standard_error() as errors:
            handles = orders, progress, errors
            with contextlib.suppress(EOFError, OSError):
                return self._ask(order, handles)
            try:
                return self._ask(order, handles)
            except EOFError as error:
                raise OSError("the process that should have started it has ended") from error

    def close(self) -> None:
        """End it; fork servers that came from it go on. Again does nothing."""
        with self._lock:
            self._close()

    def forget(self) -> None:
        """Leave it to the program that this one was forked from."""
        self._lock = threading.Lock()
        self._close()

    def _ask(self, order: StartOrder, handles: tuple[int, ...]) -> int:
        connection, process = self._started(order.environment)
        try:
            connection.send(order)
            for handle in handles:
                reduction.send_handle(connection, handle, process.pid)
            server: int = connection.recv()
        except BaseException:  # what it would answer is nobody's any more
            self._close()
            raise
        return server

    def _started(self, environment: dict[str, str]) -> tuple[Connection, subprocess.Popen[bytes]]:
        read = {k: v for k, v in environment.items() if k.startswith(READ_AT_START)}
        if self._orders is not None and self._process is not None and read == self._read_at_start:
            return self._orders, self._process
        self._close()
        mine, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "workers.process.template", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env=environment,
            )
        self._orders, self._read_at_start = Connection(mine.detach()), read
        return self._orders, self._process

    def _close(self) -> None:
        if self._orders is not None:
            self._orders.close()
        if self._process is not None:
            self._process.wait()
        self._orders = self._process = None


def _environment(given: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Return this program's environment with what an FMU needs.

    The template finds this package in it too.
    """
    found = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **dict(given)}
    own = str(Path(__file__).parents[2])
    path = os.pathsep.join([own, *filter(None, [found.get("PYTHONPATH")])])
    return {**found, "PYTHONPATH": path}


@contextlib.contextmanager
def _standard_error() -> Iterator[int]:
    """The descriptor of this program's standard error; of a program without one, of nowhere."""
    if sys.__stderr__ is not None:
        yield sys.__stderr__.fileno()
        return
    with Path(os.devnull).open("wb") as nowhere:
        yield nowhere.fileno()


def _folder() -> str:
    """Return the folder that this program works in; "" if that has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


TEMPLATE = TemplateClient()
"""That of this program."""
atexit.register(TEMPLATE.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=TEMPLATE.forget)
