"""The process that fork servers are copied from: all imports are done and the kernels are read.

There is one for a program, or for all actors of a pool on one machine, started with the first FMU
that needs a process of its own; for every other one a fork server is there in milliseconds instead
of the second that imports take. Nothing of an FMU is ever loaded here, so that no FMU leaves
anything to another. It ends when all who have a connection to it have closed that or ended; the
fork servers that came from it have connections of their own and do not need it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import sys
from collections.abc import Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import IntArray
from workers.process.fork_server import serve_forks
from workers.process.orders import Installation, StartOrder
from workers.process.watch import map_progress


def main(descriptor: int, listening: int | None = None, address: str = "") -> None:
    """Start fork servers as told, and say their ids.

    Parameters
    ----------
    descriptor
        Of the connection to who has started this process.
    listening, address
        Descriptor of the socket at which others ask for a connection, and where it is; nothing if
        there are no others. This process then ends at once and a fork goes on: it is no child of
        who has started it, and does not end with that.
    """
    if listening is None:
        _serve([Connection(descriptor)], None)
    elif not os.fork():
        with socket.socket(fileno=listening) as listener:
            _serve([Connection(descriptor)], listener)
        with contextlib.suppress(OSError):  # somebody else listens there, or has removed it
            Path(address).unlink()
            Path(address).parent.rmdir()


def _serve(clients: list[Connection], listener: socket.socket | None) -> None:
    """Serve all clients, and those that come, until none is left."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody asks here how a fork server ended
    others = [] if listener is None else [listener]
    while clients:
        for ready in wait([*clients, *others]):
            if isinstance(ready, socket.socket):
                with contextlib.suppress(OSError):  # it has gone before it was let in
                    clients.append(Connection(ready.accept()[0].detach()))
            elif isinstance(ready, Connection) and not _served(ready, [*clients, *others]):
                ready.close()
                clients.remove(ready)


def _served(client: Connection, inherited: Sequence[Connection | socket.socket]) -> bool:
    """Do what a client asks for; False if it has gone."""
    try:
        order: StartOrder = client.recv()
        handles = [reduction.recv_handle(client) for _ in range(3)]
    except (EOFError, OSError):
        return False
    progress = map_progress(handles[1])
    evaluator = _prepare(order.installation, progress)
    server = os.fork()
    if server == 0:
        for each in inherited:
            each.close()
        _settle(order, handles[2])
        serve_forks(Connection(handles[0]), evaluator)
        os._exit(0)
    del evaluator, progress, order
    gc.collect()  # experiments may be large
    for handle in handles:
        os.close(handle)
    with contextlib.suppress(OSError):  # it is seen when it is asked next
        client.send(server)
    return True


def _prepare(installation: Installation, progress: IntArray) -> Evaluator | ModelError:
    """All but the FMU; kernels that are read for it stay in this process, for all that follow."""
    try:
        return Evaluator(*installation, load=False, progress=progress)
    except ModelError as error:
        return error


def _settle(order: StartOrder, errors: int) -> None:
    """Take on, in a new fork server, what a process that the program starts would inherit.

    What an FMU prints is kept out of what the program prints to its standard output.
    """
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.clear()
    os.environ.update(order.environment)
    with contextlib.suppress(OSError):  # it has been removed
        os.chdir(order.folder)
    os.dup2(errors, 2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(2 if order.installation[0].logging_on else nowhere, 1)
    os.close(nowhere)
    os.close(errors)


if __name__ == "__main__":
    started, *shared = sys.argv[1:]
    main(int(started), *(int(shared[0]), shared[1]) if shared else ())
    os._exit(0)  # whoever started it waits for its end
