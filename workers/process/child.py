"""The process that an FMU lives in, so that nothing else dies with it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.fmu.instance import instances_made
from workers.fmu.surroundings import enter_working_folder
from workers.probes.base import FmuProbe
from workers.probes.memory import resident_bytes
from workers.process.orders import BatchReport
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
