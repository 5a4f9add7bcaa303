"""The handlers of signals are those of the process again, whichever thread leaves last."""

import ctypes
import signal
import sys
import time
from contextlib import ExitStack

import pytest

from workers.fmu.signal_handlers import ROOM, kept_signal_handlers

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there is no sigaction")


def handlers() -> list[bytes]:
    """Return what the C library has for both signals."""
    library, found = ctypes.CDLL(None), []
    for number in (signal.SIGINT, signal.SIGTERM):
        room = ctypes.create_string_buffer(ROOM)
        library.sigaction(int(number), None, room)
        found.append(room.raw[:8])  # the handler; flags beside it are the library's own
    return found


def replace_handlers() -> None:
    """Do as an FMU does: without Python's knowledge."""
    ignore = ctypes.c_void_p(1)  # SIG_IGN
    library = ctypes.CDLL(None)
    library.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
    library.signal.restype = ctypes.c_void_p
    for number in (signal.SIGINT, signal.SIGTERM):
        library.signal(int(number), ignore)


@pytest.mark.parametrize("first_out", [0, 1])
def test_a_second_thread_does_not_take_an_fmus_handlers_for_the_process_s(first_out: int) -> None:
    before = handlers()
    threads = [ExitStack(), ExitStack()]
    threads[0].enter_context(kept_signal_handlers())
    replace_handlers()
    threads[1].enter_context(kept_signal_handlers())
    replace_handlers()
    threads[first_out].close()
    assert handlers() == before
    threads[1 - first_out].close()
    assert handlers() == before


def test_handlers_that_were_replaced_once_are_given_back_during_the_next_call() -> None:
    """Otherwise nobody could interrupt an FMU that replaces them and then takes its time."""
    before = handlers()
    with kept_signal_handlers():
        replace_handlers()
    with kept_signal_handlers():
        replace_handlers()
        while handlers() != before:  # the FMU at work
            time.sleep(0.01)
    assert handlers() == before
