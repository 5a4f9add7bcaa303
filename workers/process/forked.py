"""Processes that stand ready in milliseconds: template, fork servers and forks, from outside.

What they say to each other stands here, and so does who starts and asks them. Whoever only asks
imports this alone: an evaluator, and all that it needs, stays in the processes that simulate.
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
"""What a fork server is told."""

Installation = tuple[Model, tuple[Experiment, ...], str]
"""The model, the experiments and the worker's name: what an `Evaluator` is made of."""


@dataclass(frozen=True)
class StartOrder:
    """A fork server that is wanted. Three handles follow: orders, progress, standard error.

    Attributes
    ----------
    installation
        What its processes make their evaluators of.
    environment, folder
        What the program has now: its environment variables, and the folder that it works in.
    """

    installation: Installation
    environment: dict[str, str]
    folder: str


@dataclass(frozen=True)
class BatchReport:
    """Answers to a batch, and what the process has come to.

    Attributes
    ----------
    answers
        In the order of the batch.
    resident, instances
        Bytes in memory, and FMU instances that it has made.
    spent
        Whether it can make no instance any more, which may have failed tasks after the first.
    """

    answers: OutcomeColumns
    resident: int
    instances: int
    spent: bool = False


Answer = TypeVar("Answer")
MOST_WAITING = 4096
"""Programs that may wait for a shared template at once."""


class TemplateClient:
    """The template process of this program, or one that it shares with others on this machine.

    It is started when it is needed first, and again if somebody has killed it or an environment
    variable has changed that it could only read when it started.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: Connection | None = None
        self._read_at_start: dict[str, str] = {}
        self._group = ""

    def share(self, group: str) -> None:
        """Share one template with all programs of a group on this machine, from now on.

        Many workers are ready sooner and need less memory if not each has a template of its own.

        Parameters
        ----------
        group
            A name that nobody can guess who does not belong to it.
        """
        with self._lock:
            self._close()
            self._group = group

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
            return _at_second_try(lambda: self._ask(order, handles))

    def close(self) -> None:
        """End it; fork servers that came from it go on. Again does nothing."""
        with self._lock:
            if self._orders is not None:
                _hang_up(self._orders)
            self._close()

    def forget(self) -> None:
        """Leave it to the program that this one was forked from."""
        self._lock = threading.Lock()
        self._close()

    def _ask(self, order: StartOrder, handles: tuple[int, ...]) -> int:
        connection = self._started(order.environment)
        try:
            connection.send(order)
            for handle in handles:  # the process's id matters on systems that cannot fork
                reduction.send_handle(connection, handle, os.getpid())
            server: int = connection.recv()
        except BaseException:  # what it would answer is nobody's any more
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
        """Start one, for all that have its address if it has one."""
        mine, theirs = socket.socketpair()
        with theirs, contextlib.ExitStack() as until_started:
            passed, words = [theirs.fileno()], [str(theirs.fileno())]
            if address is not None and (listener := _listening(address)) is not None:
                until_started.enter_context(listener)
                passed.append(listener.fileno())
                words += [str(listener.fileno()), str(address)]
            self._process = subprocess.Popen(
                # -P: a signal.py or numpy.py in the current folder is not what is imported
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
            self._process.wait()  # a shared one has left it, and goes on for the others
        self._orders = self._process = None


def _at_second_try(ask: Callable[[], Answer]) -> Answer:
    """Ask a process for another one, and its successor if it has ended."""
    with contextlib.suppress(EOFError, OSError):
        return ask()
    try:
        return ask()
    except EOFError as error:
        raise OSError("the process that should have started it has ended") from error


def _hang_up(connection: Connection) -> None:
    """End a connection for the other side too where a copy that an FMU has forked holds it open."""
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(connection.fileno())) as held:
        held.shutdown(socket.SHUT_RDWR)


def shared_address(group: str, read_at_start: dict[str, str]) -> Path:
    """Return where the template of a group listens whose environment holds such variables."""
    kind = hashlib.sha256(repr(sorted(read_at_start.items())).encode()).hexdigest()[:8]
    return Path(tempfile.gettempdir()) / f"cluster-est-{group}" / kind


def _joined(address: Path | None) -> Connection | None:
    """A connection to the template that listens there; None if none does."""
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
    """A socket that listens there, in place of one whose template has ended; None if none can.

    It takes the address before its template runs, so that whoever comes next waits for this one.
    """
    listener = socket.socket(socket.AF_UNIX)
    own = address.with_name(f"{address.name}-{uuid.uuid4().hex[:6]}")
    try:
        address.parent.mkdir(mode=0o700, exist_ok=True)
        listener.bind(str(own))
        listener.listen(MOST_WAITING)
        own.rename(address)
    except OSError:  # no such folder, or its name is too long for a socket: it is not shared
        listener.close()
        return None
    return listener


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
"""The client of this program's template."""


def share_template(group: str) -> None:
    """Share this program's template with a group; see `TemplateClient.share`."""
    TEMPLATE.share(group)


atexit.register(TEMPLATE.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=TEMPLATE.forget)


CAN_FORK = hasattr(os, "fork")
"""Whether this system has processes of this kind; Windows has not."""


class ForkClient:
    """Starts processes that serve an installation, and says how they ended.

    The process that forks them is started with the first, and again if somebody has killed it.

    Parameters
    ----------
    installation
        What each process is given; see `workers.process.template.serve`.

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
        return _at_second_try(lambda: self._fork(effects))

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
