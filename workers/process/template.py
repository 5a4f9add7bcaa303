"""The process that fork servers are copied from, and the fork servers: all imports are done there.

There is one template for a program, or for all actors of a pool on one machine, started with the
first FMU that needs a process of its own; for every other one a fork server is there in
milliseconds instead of the second that imports take. Nothing of an FMU is ever loaded in the
template, so that no FMU leaves anything to another. It ends when all who have a connection to it
have closed that or ended; the fork servers that came from it have connections of their own and do
not need it.

A fork server forks the processes of one installation. Forking a worker itself would copy locks that
its other threads hold; a fork server never has a second thread. It comes from the template with its
evaluator prepared, does what a `ForkClient` says over one connection, and ends, with all that it
has forked, when the connection ends or it is told to.

The fork server of `multiprocessing` is not used because it prepares modules, not objects: each of
its children would be sent the model and the experiments and prepare the evaluator again. There is
one for a whole program, not one for each model, so what FMUs print could not be kept apart, and it
imports the program's main module. When a parent is killed it ends without its children: one that
simulates goes on until it reads from its connection.
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
"""What Linux ends first when memory runs out."""


def serve(connection: Connection, evaluator: Evaluator | ModelError) -> None:
    """Load the FMU, say None or the ModelError, then answer batches until there are no more."""
    gc.freeze()  # what was forked is shared with others as long as nobody writes to it
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
    """End when the parent does, even in the middle of a simulation; go first if memory is short."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_GO, encoding="ascii")


def serve_forks(orders: Connection, evaluator: Evaluator | ModelError) -> None:
    """Fork and wait as told: `FORK` and a connection's handle, or the id of an ended process.

    `evaluator` is ready but for the FMU; or what is wrong with it, for the processes to say.
    """
    running: set[int] = set()
    if isinstance(evaluator, Evaluator):
        model = evaluator.model
        with contextlib.suppress(ModelError):  # which those say that load it
            unpack(model.name, model.archive, model.archive_hash)  # compared once for all of them
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
                    connection = Connection(handle)  # kept: an FMU may have closed it
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
    """Give a forked process a random state of its own.

    An FMU in Python shares this interpreter. With the state that all forks inherit it would draw
    the same numbers in each, and what never repeats would seem to. Python's `random` does the same
    by itself, and NumPy's where it is loaded only afterwards.
    """
    if (loaded := sys.modules.get("numpy.random")) is not None:
        loaded.seed()


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
    """All but the FMU; what is imported for it stays in this process, for all that follow."""
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
