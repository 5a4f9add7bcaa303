"""The template process and the fork servers, which are forked from it. All imports are done there.

A program has one template; all actors of a pool on one machine share one. It starts with the first
FMU that needs a separate process. A fork server then starts in milliseconds instead of the second
that imports take. The template never loads an FMU, so FMUs cannot influence each other. It ends
when all clients have closed their connections. Its fork servers have their own connections and do
not need it.

A fork server forks the processes of one installation. Forking a worker itself would copy locks held
by its other threads; a fork server never has a second thread. It starts with a prepared evaluator
and executes the orders of a `ForkClient`. It ends with all its processes when the connection ends
or when it is ordered to.

The fork server of `multiprocessing` is not used because it prepares modules, not objects. Each of
its children would receive the model and the experiments and prepare the evaluator again. There is
one for a whole program, not one for each model, so output printed by FMUs could not be separated.
It also imports the program's main module. If a parent is killed, it ends without its children: a
simulating child continues until it reads from its connection.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import socket
import sys
from collections.abc import Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from workers.errors import ModelError
from workers.evaluate import Evaluator, FmuProbe
from workers.fmu.archive import unpack
from workers.fmu.instance import instances_made
from workers.fmu.process_environment import enter_working_folder, resident_bytes
from workers.messages import IntArray
from workers.process.forked import (
    END,
    FORK,
    FORK_FOR_EFFECTS,
    BatchReport,
    Installation,
    StartOrder,
)
from workers.process.progress_watch import map_progress
from workers.wire import OutcomeColumns

DIES_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""
FIRST_TO_GO = "1000"
"""Score that makes Linux end the process first when memory runs out."""


def serve(connection: Connection, evaluator: Evaluator | ModelError) -> None:
    """Load the FMU, send None or a ModelError, then answer batches until the connection ends."""
    gc.freeze()  # unmodified memory stays shared with the parent
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _leave_before_others()
    try:
        if isinstance(evaluator, ModelError):
            raise evaluator
        enter_working_folder(evaluator.model)
        evaluator.load()
    except ModelError as error:
        connection.send(error)
        return
    connection.send(None)
    with contextlib.suppress(EOFError, OSError):
        while True:
            asked = connection.recv()
            if isinstance(asked, FmuProbe):
                connection.send(_probed(asked, evaluator))
                continue
            answers = OutcomeColumns.of(evaluator.evaluate(asked))
            has = resident_bytes("self"), instances_made(), evaluator.has_lost_seat
            connection.send(BatchReport(answers, *has))
    evaluator.close()


def _probed(probe: FmuProbe, evaluator: Evaluator) -> Any:
    try:
        return probe.answer(evaluator)
    except ModelError as error:
        return error


def _leave_before_others() -> None:
    """End with the parent, even during a simulation, and be killed first if memory is short."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_GO, encoding="ascii")


def serve_forks(orders: Connection, evaluator: Evaluator | ModelError) -> None:
    """Execute orders: `FORK` with a connection's handle, or the id of a process to wait for.

    `evaluator` is complete except for the FMU, or is the error that the processes report.
    """
    running: set[int] = set()
    if isinstance(evaluator, Evaluator):
        model = evaluator.model
        with contextlib.suppress(ModelError):  # loading reports the error
            unpack(model.name, model.archive, model.archive_hash)  # once for all processes
    with contextlib.suppress(EOFError, OSError):
        while (order := orders.recv()) != END:
            if order == FORK_FOR_EFFECTS:
                import workers.simulation.bind_effects  # noqa: F401 (for all processes that follow)
            if order in (FORK, FORK_FOR_EFFECTS):
                handle = reduction.recv_handle(orders)
                child = os.fork()
                if child == 0:
                    orders.close()
                    draw_anew()
                    connection = Connection(handle)  # kept because an FMU may have closed it
                    serve(connection, evaluator)
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
    """Give a forked process its own random state.

    An FMU in Python uses this interpreter. With the inherited state, it would draw the same numbers
    in every fork, so a random simulation would seem repeatable. Python's `random` reseeds itself
    after a fork, and so does NumPy if it is imported later.
    """
    if (loaded := sys.modules.get("numpy.random")) is not None:
        loaded.seed()


def main(descriptor: int, listening: int | None = None, address: str = "") -> None:
    """Start fork servers by order, and send their process ids.

    Parameters
    ----------
    descriptor
        Descriptor of the connection to the program that has started this process.
    listening, address
        Descriptor and address of the socket for connections of other programs; empty if the
        template is not shared. A shared template continues in a fork and this process ends at once,
        so the template is not a child of the program and does not end with it.
    """
    if listening is None:
        _serve([Connection(descriptor)], None)
    elif not os.fork():
        with socket.socket(fileno=listening) as listener:
            _serve([Connection(descriptor)], listener)
        with contextlib.suppress(OSError):  # it was replaced or removed
            Path(address).unlink()
            Path(address).parent.rmdir()


def _serve(clients: list[Connection], listener: socket.socket | None) -> None:
    """Serve all clients, including new ones, until none is left."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # exit codes of fork servers are not needed
    others = [] if listener is None else [listener]
    while clients:
        for ready in wait([*clients, *others]):
            if isinstance(ready, socket.socket):
                with contextlib.suppress(OSError):  # the client has ended in the meantime
                    clients.append(Connection(ready.accept()[0].detach()))
            elif isinstance(ready, Connection) and not _served(ready, [*clients, *others]):
                ready.close()
                clients.remove(ready)


def _served(client: Connection, inherited: Sequence[Connection | socket.socket]) -> bool:
    """Execute an order of a client; return False if the client has ended."""
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
    with contextlib.suppress(OSError):  # noticed at the next order
        client.send(server)
    return True


def _prepare(installation: Installation, progress: IntArray) -> Evaluator | ModelError:
    """Return an evaluator without a loaded FMU; its imports stay in this process."""
    try:
        return Evaluator(*installation, load=False, progress=progress)
    except ModelError as error:
        return error


def _settle(order: StartOrder, errors: int) -> None:
    """Set up a new fork server like a process that the program starts itself.

    Output printed by an FMU is kept separate from the program's standard output.
    """
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.clear()
    os.environ.update(order.environment)
    with contextlib.suppress(OSError):  # the folder was removed
        os.chdir(order.folder)
    os.dup2(errors, 2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(2 if order.installation[0].logging_on else nowhere, 1)
    os.close(nowhere)
    os.close(errors)


if __name__ == "__main__":
    started, *shared = sys.argv[1:]
    main(int(started), *(int(shared[0]), shared[1]) if shared else ())
    os._exit(0)  # its parent waits for this exit
