"""The process that forks those of one installation: each is ready in milliseconds.

Forking a worker itself would copy locks that its other threads hold; this process never has a
second thread. It comes from the `template` with its evaluator prepared, does what a `ForkClient`
says over one connection, and ends, with all that it has forked, when the connection ends or it is
told to.

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
import sys
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.fmu.archive import unpack
from workers.fmu.instance import instances_made
from workers.fmu.surroundings import enter_working_folder
from workers.probes.base import FmuProbe
from workers.probes.memory import resident_bytes
from workers.process.orders import END, FORK, FORK_FOR_EFFECTS, BatchReport
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
    by itself.
    """
    np.random.seed()
