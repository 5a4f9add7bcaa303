"""The process that fork servers are copied from: all imports are done and the kernels are read.

There is one for a program, started with the first FMU that needs a process of its own; for every
other one a fork server is there in milliseconds instead of the second that imports take. Nothing
of an FMU is ever loaded here, so that no FMU leaves anything to another. It ends when the program
does; the fork servers that came from it have connections of their own and do not need it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from multiprocessing import reduction
from multiprocessing.connection import Connection

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import IntArray
from workers.process.fork_server import serve_forks
from workers.process.orders import Installation, StartOrder
from workers.process.watch import map_progress


def main(descriptor: int) -> None:
    """Start fork servers as told, and say their ids."""
    orders = Connection(descriptor)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody asks here how a fork server ended
    with contextlib.suppress(EOFError, OSError):
        while True:
            order: StartOrder = orders.recv()
            handles = [reduction.recv_handle(orders) for _ in range(3)]
            progress = map_progress(handles[1])
            evaluator = _prepare(order.installation, progress)
            server = os.fork()
            if server == 0:
                orders.close()
                _settle(order, handles[2])
                serve_forks(Connection(handles[0]), evaluator)
                os._exit(0)
            del evaluator, progress, order
            gc.collect()  # experiments may be large
            for handle in handles:
                os.close(handle)
            orders.send(server)


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
    main(int(sys.argv[1]))
    os._exit(0)  # whoever started it waits for its end
