"""A process that forks others: each is ready in milliseconds, because all imports are done.

Forking a worker itself would copy locks that its other threads hold; this process never has a
second thread. It is started by a `SupervisedEvaluator`, does what that says over one connection,
and ends, with all that it has forked, when the connection ends.

The fork server of `multiprocessing` is not used because it prepares modules, not objects: each of
its children would be sent the model and the experiments and prepare the evaluator again. There is
one for a whole program, not one for each model, so what FMUs print could not be kept apart, and it
imports the program's main module. When a parent is killed it ends without its children: one that
simulates goes on until it reads from its connection.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from multiprocessing import reduction
from multiprocessing.connection import Connection

import numpy as np

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import Experiment, IntArray, Model
from workers.process.child import serve
from workers.process.watch import map_progress

FORK, FORK_FOR_EFFECTS = "fork", "fork for effects"


def main(descriptor: int, shared: int) -> None:
    """Fork and wait as told: `FORK` and a connection's handle, or the id of an ended process.

    `shared` is the descriptor of the progress that all processes note, one at a time.
    """
    orders = Connection(descriptor)
    installation = orders.recv()
    _keep_apart(installation[0])
    evaluator = _prepare(installation, map_progress(shared))
    running: set[int] = set()
    with contextlib.suppress(EOFError, OSError):
        while True:
            order = orders.recv()
            if order == FORK_FOR_EFFECTS:
                import workers.simulation.bind_effects  # noqa: F401 (for all processes that follow)
            if order in (FORK, FORK_FOR_EFFECTS):
                handle = reduction.recv_handle(orders)
                child = os.fork()
                if child == 0:
                    orders.close()
                    draw_anew()
                    serve(Connection(handle), evaluator)
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


def draw_anew() -> None:
    """Give a forked process a random state of its own.

    An FMU in Python shares this interpreter. With the state that all forks inherit it would draw
    the same numbers in each, and what never repeats would seem to. Python's `random` does the same
    by itself.
    """
    np.random.seed()


def _keep_apart(model: Model) -> None:
    """Keep what an FMU prints out of what this program prints to its standard output."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(2 if model.logging_on else nowhere, 1)
    os.close(nowhere)


def _prepare(
    installation: tuple[Model, tuple[Experiment, ...], str], progress: IntArray
) -> Evaluator | ModelError:
    """All but the FMU, ready once for all processes; or what is wrong with it, for them to say."""
    try:
        return Evaluator(*installation, load=False, progress=progress)
    except ModelError as error:
        return error


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
