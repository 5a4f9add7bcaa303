"""A parent process for a command, so that an FMU that ends the process is reported.

The command runs in a child. The parent passes signals on, waits for the child, prints a sentence if
it died, ends its remaining processes, and returns its exit code. So a model that calls `_exit(0)`
during a fit is not mistaken for a success. This works only on Linux; on other systems, the command
runs without a parent.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import enum
import math
import os
import signal
import sys
from pathlib import Path
from typing import NoReturn

SENTENCE = (
    "cluster-est: the process of this command has died ({}). It crashed, or was ended from inside "
    "or outside. Ray, for example, ends it if Ray's own process on this machine dies, perhaps "
    "because memory ran out. Continue a run that had begun with --resume"
)
OF_FMU = (
    "cluster-est: the process of this command has died ({}). An FMU that runs in this process "
    'crashed or ended it, or it was killed from outside. With executor.name = "processes", each '
    "FMU has a process of its own, and a crash ends only one simulation. Continue a run that had "
    "begun with --resume"
)
PASSED_ON = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP} if sys.platform != "win32" else set()
INTERRUPTS_BEFORE_KILL = 4
"""Number of interrupts after which the child is killed, because an FMU in it may ignore them."""
INTERRUPTED = (
    "cluster-est: interrupted ({} before the process of this command could end properly); continue "
    "a run that had begun with --resume"
)
FAREWELL, LOADED = b"farewell\n", b"loaded\n"
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h

_to_parent: list[int] = []
"""File descriptor on which this process sends messages to its parent; empty without a parent."""


def run_in_child() -> None:
    """Continue in a child of this process; the parent waits here, and ends after the child.

    The child has its own process group, so that a signal from a terminal or a scheduler reaches it
    only once, through its parent.
    """
    _open_standard_streams()
    if sys.platform != "linux":
        return
    reading, writing = os.pipe()
    watched = PASSED_ON | {signal.SIGCHLD, signal.SIGTSTP}
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # before the fork, so that none is lost
    before = signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    parent, child = os.getpid(), os.fork()
    if child:
        os.close(writing)
        _give_exit_code(child, reading, watched - _ignored(watched))
    os.close(reading)
    os.setpgid(0, 0)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # raised in an import, it may be ignored
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # it prints in the background
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    _to_parent.append(writing)


def _open_standard_streams() -> None:
    """Open closed standard streams on os.devnull, so that a file of a run does not replace them."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(descriptor, "w" if descriptor else "r", closefd=False))


def address_space() -> float:
    """Return the GB of memory that this process may address (ulimit -v)."""
    if sys.platform == "win32":
        return math.inf
    import resource

    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return math.inf if most == resource.RLIM_INFINITY else most / 1e9


def interrupts_can_be_raised() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again, once all modules are loaded."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def tell_of_fmu() -> None:
    """Report to the parent that an FMU is loaded in the process of the command."""
    _tell(LOADED)


def end(code: int, *, in_order: bool = True) -> NoReturn:
    """End the process of a command with an exit code, without the exit handlers of libraries.

    Parameters
    ----------
    code
        The exit code.
    in_order
        Whether to run the functions registered with `atexit` first.
    """
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)  # nothing remains to be interrupted
    if in_order:
        atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):  # a program may have none
        with contextlib.suppress(OSError, ValueError):  # the reader has gone
            stream.flush()
    _tell(FAREWELL)
    os._exit(code)


def _tell(word: bytes) -> None:
    with contextlib.suppress(OSError, IndexError):  # closed by an FMU, or no parent
        os.write(_to_parent[0], word)


def _ignored(signals: set[signal.Signals]) -> set[signal.Signals]:
    """Return the signals that are ignored since the start, as by nohup."""
    return {each for each in signals if signal.getsignal(each) == signal.SIG_IGN}


def _give_exit_code(child: int, reading: int, watched: set[signal.Signals]) -> NoReturn:
    """End this process in the same way as its child."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    status, interrupts = _wait(child, watched | {signal.SIGCHLD})
    _end_descendants()
    os.set_blocking(reading, False)  # remaining processes may hold the other end
    with contextlib.suppress(BlockingIOError):
        told = b""
        told = os.read(reading, 64)
    code = os.waitstatus_to_exitcode(status)
    if FAREWELL in told:
        os._exit(code)
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    said = INTERRUPTED if interrupts else OF_FMU if LOADED in told else SENTENCE
    with contextlib.suppress(OSError, ValueError, AttributeError):  # the reader has gone
        sys.stderr.write(said.format(how) + "\n")
        sys.stderr.flush()
    os._exit(130 if interrupts else 128 - code if code < 0 else code or 1)


def _wait(child: int, watched: set[signal.Signals]) -> tuple[int, int]:
    """Return the status of a finished child, and the number of interrupts passed on."""
    interrupts = 0
    while True:
        received = signal.sigwait(watched)
        if received in PASSED_ON:
            interrupts += 1
            os.kill(child, received if interrupts < INTERRUPTS_BEFORE_KILL else signal.SIGKILL)
        elif received == signal.SIGTSTP:
            os.killpg(child, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGSTOP)
            os.killpg(child, signal.SIGCONT)
        ended, status = os.waitpid(child, os.WNOHANG | os.WUNTRACED)
        if ended and os.WIFSTOPPED(status) and received == signal.SIGCHLD:
            os.kill(child, signal.SIGCONT)  # stopped by an FMU; nothing else would continue it
        elif ended and not os.WIFSTOPPED(status):
            return status, interrupts


def _end_descendants() -> None:
    """Kill remaining processes of the child, which an FMU may have started."""
    while children := _children():
        for each in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(-1, 0)


def _children() -> list[int]:
    tasks = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    return [int(each) for task in tasks for each in task.read_text().split()]


class ExitCode(enum.IntEnum):
    """The exit code of a command."""

    DONE = 0
    NO_SOLUTION = 1
    """The command ran, but did not reach a solution."""
    BAD_INPUT = 2
    """Something must be corrected first; a sentence says what."""
    CRITERION_MET = 3
    """The command succeeded, but a criterion of `--fail-if` is met."""
    INTERRUPTED = 130
