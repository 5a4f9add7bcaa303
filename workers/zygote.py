"""A process that forks others: each is ready in milliseconds, because all imports are done.

Forking a worker itself would copy locks that its other threads hold; this process never has a
second thread. It is started by a `Guard`, does what that says over one connection, and ends, with
all that it has forked, when the connection ends.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from multiprocessing import reduction
from multiprocessing.connection import Connection

from workers.child import serve
from workers.kernels.calling import kernel

FORK = "fork"


def main(descriptor: int) -> None:
    """Fork and wait as told: `FORK` with a connection's handle, or the id of an ended process."""
    orders = Connection(descriptor)
    installation = orders.recv()
    _nothing(0)
    running: set[int] = set()
    with contextlib.suppress(EOFError, OSError):
        while True:
            order = orders.recv()
            if order == FORK:
                handle = reduction.recv_handle(orders)
                child = os.fork()
                if child == 0:
                    orders.close()
                    serve(Connection(handle), *installation)
                    os._exit(0)
                os.close(handle)
                running.add(child)
                orders.send(child)
            else:
                _, status = os.waitpid(order, 0)
                running.discard(order)
                orders.send(os.waitstatus_to_exitcode(status))
    for child in running:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)


@kernel
def _nothing(number: int) -> int:
    """Called once before any fork: it makes numba ready, which takes longer than all else."""
    return number


if __name__ == "__main__":
    main(int(sys.argv[1]))
