"""A terminal: text that is printed, and lines below it that are renewed in place.

While lines are shown, what is printed goes above them, on whichever of the two standard streams.
The control sequences are those of ECMA-48, which terminals of all systems know.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import unicodedata
from collections.abc import Sequence
from typing import Protocol, Self

UP, CLEAR_LINE, CLEAR_BELOW = "\x1b[{}A", "\x1b[2K", "\x1b[J"
USUAL_WIDTH = 80
DUMB = ("dumb", "unknown")
"""Terminals, by TERM, that know no control sequences."""
WRITTEN_OUT = {number: repr(chr(number))[1:-1] for number in (*range(32), *range(127, 160))} | {
    ord("\n"): "\n",
    ord("\t"): "\t",
}
"""A terminal may obey what a file or an FMU made a message quote."""
_lock = threading.RLock()
_shown: list[LiveLines] = []


class Stream(Protocol):
    """What text is written to."""

    def write(self, text: str, /) -> object:
        """Take text."""

    def flush(self) -> None:
        """Pass it on."""


class Screen:
    """A stream, and whether it is a terminal.

    Parameters
    ----------
    stream
        Where to.
    is_terminal
        None where the stream knows; FORCE_COLOR in the environment makes it one.
    width
        In columns; None for that of the terminal, or COLUMNS in the environment.
    """

    def __init__(
        self, stream: Stream, *, is_terminal: bool | None = None, width: int | None = None
    ) -> None:
        self.stream = stream
        self.is_terminal = _is_terminal(stream) if is_terminal is None else is_terminal
        self._width = width

    @property
    def width(self) -> int:
        """Columns of a line."""
        return self._width or shutil.get_terminal_size((USUAL_WIDTH, 25)).columns

    def print(self, text: str) -> None:
        """Print lines, however long they are, above those that are renewed."""
        with _lock:
            above = [live for live in _shown if live.screen.is_terminal and self.is_terminal]
            for live in above:
                live.erase()
            self.stream.write(f"{text.translate(WRITTEN_OUT)}\n")
            self.stream.flush()
            for live in above:
                live.draw()


class LiveLines:
    """Lines that are renewed in place; nothing where there is no terminal.

    Parameters
    ----------
    screen
        Where they stand.
    stay
        Whether the last ones stay at the end.
    """

    def __init__(self, screen: Screen, *, stay: bool = False) -> None:
        self.screen, self._stay = screen, stay
        self._lines: list[str] = []
        self._drawn = 0

    def __enter__(self) -> Self:
        if self.screen.is_terminal:
            if sys.platform == "win32":
                os.system("")  # makes older consoles obey control sequences
            with _lock:
                _shown.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        with _lock:
            if self in _shown:
                _shown.remove(self)
                if not self._stay:
                    self.erase()

    def put(self, lines: Sequence[str]) -> None:
        """Show these lines in the place of the last ones, each cut to the width."""
        with _lock:
            if self in _shown:
                self.erase()
                width = self.screen.width - 1
                self._lines = [cut(line.translate(WRITTEN_OUT), width) for line in lines]
                self.draw()

    def erase(self) -> None:
        """Take the lines from the terminal."""
        if self._drawn:
            self._write(f"{UP.format(self._drawn)}\r{CLEAR_BELOW}")
            self._drawn = 0

    def draw(self) -> None:
        """Show the lines again."""
        self._write("".join(f"{CLEAR_LINE}{line}\n" for line in self._lines))
        self._drawn = len(self._lines)

    def _write(self, text: str) -> None:
        self.screen.stream.write(text)
        self.screen.stream.flush()


def cut(text: str, width: int) -> str:
    """Return a line that takes no more columns than these, with an ellipsis where it was longer."""
    if sum(map(_columns, text)) <= width:
        return text
    taken, kept = 1, []
    for letter in text:
        taken += _columns(letter)
        if taken > width:
            break
        kept.append(letter)
    return "".join(kept) + "\u2026"


def _columns(letter: str) -> int:
    """Return how many columns a letter takes."""
    if unicodedata.combining(letter):
        return 0
    return 2 if unicodedata.east_asian_width(letter) in "WF" else 1


def _is_terminal(stream: Stream) -> bool:
    if os.environ.get("TERM", "").lower() in DUMB:
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    try:
        return bool(stream.isatty())  # type: ignore[attr-defined]
    except (AttributeError, ValueError):  # none, or closed
        return False


def aligned(rows: Sequence[Sequence[str]], numeric: Sequence[int] = ()) -> list[str]:
    """Return rows of cells as lines, columns two blanks apart.

    Parameters
    ----------
    rows
        All of one length.
    numeric
        Columns that are flush right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if place in numeric else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
