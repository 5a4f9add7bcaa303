"""Text that is safe to write to a terminal."""

from __future__ import annotations

LONGEST_LINE = 2000


def readable(text: str) -> str:
    """Return a message as a terminal may get it, whatever a file made it quote.

    What is not printable is written out, because a terminal may obey it; a line that nobody would
    read to its end loses its middle.
    """
    return "\n".join(_cut("".join(map(_printable, line))) for line in text.split("\n"))


def _printable(letter: str) -> str:
    return letter if letter.isprintable() else repr(letter)[1:-1]


def _cut(line: str) -> str:
    return line if len(line) <= LONGEST_LINE else f"{line[:1000]} ... {line[-500:]}"
