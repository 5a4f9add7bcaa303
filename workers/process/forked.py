"""Client side of the template, fork servers and forks, which start a process in milliseconds.

This module contains the messages between these processes, and the code that starts and calls them.
A process that only calls them imports this module alone. Evaluators and their dependencies are
imported only in processes that simulate.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeVar

from workers.errors import ModelError
from workers.fmu.archive import prepare_folder
from workers.fmu.process_environment import READ_AT_START
from workers.messages import Experiment, Model
from workers.process.progress_watch import SharedProgress
from workers.wire import OutcomeColumns

FORK, FORK_FOR_EFFECTS, END = "fork", "fork for effects", "end"
"""Orders to a fork server."""

Installation = tuple[Model, tuple[Experiment, ...], str]
"""The model, the experiments and the worker's name: the arguments of an `Evaluator`."""


@dataclass(frozen=True)
class StartOrder:
    """Order to start a fork server. Three handles follow: orders, progress, standard error.

    Attributes
    ----------
    installation
        Arguments of the evaluators in its processes.
    environment, folder
        The program's current environment variables and working folder.
    """

    installation: Installation
    environment: dict[str, str]
    folder: str


@dataclass(frozen=True)
class BatchReport:
    """Answers to a batch, and the state of the process.

    Attributes
    ----------
    answers
        In the order of the batch.
    resident, instances
        Bytes in memory, and number of FMU instances that the process has made.
    spent
        Whether the process can make no more instances, so tasks after the first may have failed.
    """

    answers: OutcomeColumns
    resident: int
    instances: int
    spent: bool = False


Answer = TypeVar("Answer")
MOST_WAITING = 4096
"""Number of programs that may wait for a shared template at once."""


class TemplateClient:
    """The template process of this program, or one shared with other programs on this machine.

    It is started when it is first needed. It is started again if it was killed, or if an
    environment variable has changed that a process reads only at its start.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: Connection | None = None
        self._read_at_start: dict[str, str] = {}
        self._group = ""

    def share(self, group: str) -> None:
        """From now on, share one template with all programs of a group on this machine.

        Many workers with a common template start faster and need less memory.

        Parameters
        ----------
        group
            A name that cannot be guessed by others.
        """
        with self._lock:
            self._close()
            self._group = group

    def fork_server(self, installation: Installation, orders: int, progress: int) -> int:
        """Start a fork server.

        Parameters
        ----------
        installation
            Arguments of the evaluators in its processes.
        orders
            Descriptor of the connection from which it receives orders.
        progress
            Descriptor of the memory in which its processes record their progress.

        Returns
        -------
        int
            The process id.

        Raises
        ------
        OSError
            If it cannot be started.
        """
        order = StartOrder(installation, _environment(installation[0].environment), _folder())
        with self._lock, _standard_error() as errors:
            handles = orders, progress, errors
            return _at_second_try(lambda: self._ask(order, handles))

    def close(self) -> None:
        """End the template; its fork servers continue. A second call does nothing."""
        with self._lock:
            if self._orders is not None:
                _hang_up(self._orders)
            self._close()

    def forget(self) -> None:
        """Leave the template to the parent process from which this process was forked."""
        self._lock = threading.Lock()
        self._close()

    def _ask(self, order: StartOrder, handles: tuple[int, ...]) -> int:
        connection = self._started(order.environment)
        try:
            connection.send(order)
            for handle in handles:  # the process id is needed on systems without fork
                reduction.send_handle(connection, handle, os.getpid())
            server: int = connection.recv()
        except BaseException:  # nobody will read its answer any more
            self._close()
            raise
        return server

    def _started(self, environment: dict[str, str]) -> Connection:
        read = {k: v for k, v in environment.items() if k.startswith(READ_AT_START)}
        if self._orders is not None and read == self._read_at_start:
            return self._orders
        self._close()
        address = shared_address(self._group, read) if self._group else None
        self._orders = _joined(address) or self._own(environment, address)
        self._read_at_start = read
        return self._orders

    def _own(self, environment: dict[str, str], address: Path | None) -> Connection:
        """Start a template, and share it if it has an address."""
        mine, theirs = socket.socketpair()
        with theirs, contextlib.ExitStack() as until_started:
            passed, words = [theirs.fileno()], [str(theirs.fileno())]
            if address is not None and (listener := _listening(address)) is not None:
                until_started.enter_context(listener)
                passed.append(listener.fileno())
                words += [str(listener.fileno()), str(address)]
            self._process = subprocess.Popen(
                # -P: do not import a signal.py or numpy.py in the current folder
                [sys.executable, "-P", "-m", "workers.process.template", *words],
                pass_fds=passed,
                start_new_session=True,
                env=environment,
            )
        return Connection(mine.detach())

    def _close(self) -> None:
        if self._orders is not None:
            self._orders.close()
        if self._process is not None:
            self._process.wait()  # a shared template has left this process and continues for others
        self._orders = self._process = None


def _at_second_try(ask: Callable[[], Answer]) -> Answer:
    """Call `ask` and return its result; if the process has ended, call it a second time."""
    with contextlib.suppress(EOFError, OSError):
        return ask()
    try:
        return ask()
    except EOFError as error:
        raise OSError("the process that should have started it has ended") from error


def _hang_up(connection: Connection) -> None:
    """Shut down a connection, even if a process that an FMU has forked holds a copy of it."""
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(connection.fileno())) as held:
        held.shutdown(socket.SHUT_RDWR)


def shared_address(group: str, read_at_start: dict[str, str]) -> Path:
    """Return the socket address of a group's template with these environment variables."""
    kind = hashlib.sha256(repr(sorted(read_at_start.items())).encode()).hexdigest()[:8]
    return Path(tempfile.gettempdir()) / f"cluster-est-{group}" / kind


def _joined(address: Path | None) -> Connection | None:
    """Return a connection to the template at an address; None if there is none."""
    if address is None:
        return None
    joining = socket.socket(socket.AF_UNIX)
    try:
        joining.connect(str(address))
    except OSError:
        joining.close()
        return None
    return Connection(joining.detach())


def _listening(address: Path) -> socket.socket | None:
    """Return a socket that listens at an address, replacing that of an ended template, or None.

    It exists before its template runs, so that clients that come later wait for this template.
    """
    listener = socket.socket(socket.AF_UNIX)
    own = address.with_name(f"{address.name}-{uuid.uuid4().hex[:6]}")
    try:
        address.parent.mkdir(mode=0o700, exist_ok=True)
        listener.bind(str(own))
        listener.listen(MOST_WAITING)
        own.rename(address)
    except OSError:  # no such folder, or its name is too long for a socket
        listener.close()
        return None
    return listener


def _environment(given: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Return this program's environment together with the variables that an FMU needs.

    `PYTHONPATH` lets the template find this package.
    """
    found = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **dict(given)}
    own = str(Path(__file__).parents[2])
    path = os.pathsep.join([own, *filter(None, [found.get("PYTHONPATH")])])
    return {**found, "PYTHONPATH": path}


@contextlib.contextmanager
def _standard_error() -> Iterator[int]:
    """Yield the descriptor of this program's standard error; without one, that of os.devnull."""
    if sys.__stderr__ is not None:
        yield sys.__stderr__.fileno()
        return
    with Path(os.devnull).open("wb") as nowhere:
        yield nowhere.fileno()


def _folder() -> str:
    """Return the working folder of this program; "" if it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


TEMPLATE = TemplateClient()
"""The client of this program's template."""


def share_template(group: str) -> None:
    """Share this program's template with a group; see `TemplateClient.share`."""
    TEMPLATE.share(group)


atexit.register(TEMPLATE.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=TEMPLATE.forget)


CAN_FORK = hasattr(os, "fork")
"""Whether this system can fork processes; Windows cannot."""


class ForkClient:
    """Starts processes that serve an installation, and returns their exit codes.

    The fork server is started with the first process, and again if it was killed.

    Parameters
    ----------
    installation
        Arguments of the evaluators; see `workers.process.template.serve`.

    Attributes
    ----------
    progress
        Progress of the process that was forked last; see `workers.messages.types`.
    server
        Process id of the fork server; 0 before the first fork.

    Raises
    ------
    ModelError
        On a system that cannot fork.
    """

    def __init__(self, installation: Installation) -> None:
        if not CAN_FORK:
            raise ModelError(
                "an FMU in a separate process needs a system that can fork processes, such as "
                'Linux or macOS, but this system cannot; use executor.name = "local"'
            )
        prepare_folder()
        self._installation = installation
        self._shared = SharedProgress()
        self._orders: Connection | None = None
        self.progress = self._shared.progress
        self.server = 0

    def fork(self, *, effects: bool = False) -> tuple[int, Connection]:
        """Start a new process; return its id, and a connection to it.

        Parameters
        ----------
        effects
            Whether it will simulate effects, whose import takes half a second.

        Raises
        ------
        OSError
            If it cannot be started.
        """
        self.progress[:] = 0
        return _at_second_try(lambda: self._fork(effects))

    def wait(self, process: int) -> int | None:
        """Wait for a process to end; return its exit code, or minus the signal that ended it.

        None if the code is unknown.
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
        """End all processes. A second call does nothing."""
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
        except BaseException:  # nobody will read its answer any more
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
        """End the fork server, and wait until it and its processes have ended."""
        if self._orders is None:
            return
        with self._orders as orders, contextlib.suppress(EOFError, OSError):
            orders.send(END)
            while True:
                orders.recv()
        self._orders = None
