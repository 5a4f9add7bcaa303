"""Interrupts of a run by Ctrl-C, SIGTERM, SIGHUP or a stop file.

An interrupt during a write would damage the log. So an active runner only records interrupts, and
raises them while it waits for workers.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

TERMINATION_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
STOP_FILE_POLL_SECONDS = 0.5
INTERRUPTS_BEFORE_RAISE = 3
"""Number of interrupts after which an interrupt is raised at once, at any place."""


class DeferredInterrupts:
    """A context that records interrupts, and raises them as KeyboardInterrupt while `waiting`.

    It does nothing outside the main thread, because only the main thread receives signals. It does
    not replace handlers that other code has installed.
    """

    def __init__(self) -> None:
        self.noted = 0
        self._waiting = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in TERMINATION_SIGNALS:
                before = signal.getsignal(number)
                if isinstance(before, _RaisingHandler):
                    self.noted += before.noted
                if before is signal.default_int_handler or isinstance(before, _RaisingHandler):
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()
        if self.noted and kind is None:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Raise interrupts within this context, including recorded ones."""
        self._waiting = True
        try:
            if self.noted:
                raise KeyboardInterrupt
            yield
            if self.noted:  # the exception was lost, as in a callback from C
                raise KeyboardInterrupt
        finally:
            self._waiting = False

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.noted += 1
        for before in self._before.values():
            if isinstance(before, _RaisingHandler):
                before.interrupted = True
        if self._waiting or self.noted >= INTERRUPTS_BEFORE_RAISE:
            raise KeyboardInterrupt


class _RaisingHandler:
    """A handler that raises at once, and records the interrupt in case the exception is lost.

    Compiled code of other libraries may print the exception and go on.
    """

    def __init__(self) -> None:
        self.noted, self.interrupted = 0, False

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.noted, self.interrupted = self.noted + 1, True
        raise KeyboardInterrupt


@contextlib.contextmanager
def terminations() -> Iterator[None]:
    """Make SIGTERM (batch systems) and SIGHUP (closed terminals) interrupt as Ctrl-C does.

    No interrupt is lost. If SIGHUP is ignored (nohup), it stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = _RaisingHandler()
    before: dict[signal.Signals, Any] = {}
    for number in TERMINATION_SIGNALS:
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        if number == signal.SIGTERM or signal.getsignal(number) is usual:
            before[number] = signal.signal(number, handler)
    try:
        with _quiet(handler):
            yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def _quiet(handler: _RaisingHandler) -> Iterator[None]:
    """Suppress tracebacks of interrupts whose exception was lost; they are raised again later.

    After an interrupt, also suppress unraisable errors, such as errors of half-built objects.
    """
    printing, unraisable = sys.excepthook, sys.unraisablehook

    def print_others(
        kind: type[BaseException], error: BaseException, traceback: TracebackType | None
    ) -> None:
        if not issubclass(kind, KeyboardInterrupt):
            printing(kind, error, traceback)

    def tell_others(unraised: sys.UnraisableHookArgs) -> None:
        if not handler.interrupted and not issubclass(unraised.exc_type, KeyboardInterrupt):
            unraisable(unraised)

    sys.excepthook, sys.unraisablehook = print_others, tell_others
    try:
        yield
    finally:
        sys.excepthook, sys.unraisablehook = printing, unraisable


@contextlib.contextmanager
def later(seconds: float) -> Iterator[None]:
    """Interrupt the main thread if the block takes longer than `seconds`."""
    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def stopped_by(path: Path) -> Iterator[None]:
    """Interrupt the main thread as soon as a file exists; remove an old file first."""
    _remove(path)
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(STOP_FILE_POLL_SECONDS):
            if path.exists():
                interrupt()
                return

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()
        _remove(path)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):  # other code reports an invalid folder
        path.unlink()


def interrupt() -> None:
    """Interrupt the main thread as Ctrl-C does, even if it waits in a system call."""
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, signal.SIGINT)
    else:  # on Windows the interrupt takes effect after the system call
        _thread.interrupt_main()
