"""Ctrl-C, SIGTERM, SIGHUP and a stop file: they end a run where that spoils nothing.

An interrupt in the middle of a write would tear the log, so while a runner is at work it is only
noted, and raised where the runner waits for workers.
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
"""Interrupts after which one is raised at once, wherever that is."""


class DeferredInterrupts:
    """Notes interrupts while it is entered; raises them as KeyboardInterrupt while `waiting`.

    Only the main thread receives signals: in others this does nothing. Where somebody has installed
    a handler of his own, that stays.
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
        """Let interrupts be raised here, also those that were noted before."""
        self._waiting = True
        try:
            if self.noted:
                raise KeyboardInterrupt
            yield
            if self.noted:  # it was raised where nothing can be, as in a callback from C
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
    """A handler that interrupts at once, and remembers it in case nothing could be raised there.

    Compiled code of other libraries prints such an exception and goes on.
    """

    def __init__(self) -> None:
        self.noted, self.interrupted = 0, False

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.noted, self.interrupted = self.noted + 1, True
        raise KeyboardInterrupt


@contextlib.contextmanager
def terminations() -> Iterator[None]:
    """Let SIGTERM, of batch systems, and SIGHUP, of a terminal that goes, interrupt as Ctrl-C does.

    None of them is lost. A program that is to outlive its terminal (nohup) ignores SIGHUP.
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
    """Print no traceback of an interrupt that nobody could raise: it comes again later.

    Nor of what was being made when one came, and is taken down half made.
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
    """Interrupt the main thread if the block takes longer."""
    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def stopped_by(path: Path) -> Iterator[None]:
    """Interrupt the main thread once a file is there; one that is left from before is removed."""
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
    with contextlib.suppress(OSError):  # no such folder, or it is a file: others say so
        path.unlink()


def interrupt() -> None:
    """Interrupt the main thread as Ctrl-C does, even if it waits in a system call."""
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, signal.SIGINT)
    else:  # Windows, where it comes when the system call is over
        _thread.interrupt_main()
