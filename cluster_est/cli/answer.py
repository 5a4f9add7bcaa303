"""What a command says: sentences and tables for people, or one JSON document for programs.

A command gives its answer sentences, tables and the fields of its document, and does not know who
reads them. `cluster_est.cli.document` declares the fields.
"""

from __future__ import annotations

import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console
from typing_extensions import override

Cell = Callable[[dict[str, Any]], str]
"""What stands in a column of a row."""


class Answer(ABC):
    """The answer of one command.

    Attributes
    ----------
    found
        Fields of its document, as `cluster_est.cli.document` declares them.
    sentences, complaints
        What was said so far, on standard output and beside it.
    """

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}
        self.sentences: list[str] = []
        self.complaints: list[str] = []

    def add(self, **found: Any) -> None:
        """Add fields of the document."""
        self.found |= found

    def complain(self, text: str) -> None:
        """Print a sentence beside the output, with the program's name."""
        self.complaints.append(text)
        _print_error(text)

    def fail(self, text: str) -> None:
        """Say why there is no answer."""
        self.add(message=text)
        _print_error(text)

    def rows(self, rows: Iterable[dict[str, Any]], *columns: tuple[str, str | Cell]) -> None:
        """A table: for each column its name, and a key of the rows or what makes its cells."""
        self.table(
            [name for name, _ in columns],
            [[str(r[of]) if isinstance(of, str) else of(r) for _, of in columns] for r in rows],
        )

    @abstractmethod
    def say(self, text: str) -> None:
        """One line, however narrow the terminal."""

    @abstractmethod
    def tell(self, text: str) -> None:
        """A sentence: broken between words in a terminal, one line elsewhere."""

    @abstractmethod
    def table(self, header: list[str], rows: Iterable[Iterable[str]]) -> None:
        """A table without lines; a document has its numbers in a field instead."""


def _print_error(text: str) -> None:
    errors = Console(stderr=True, markup=False, highlight=False, emoji=False)
    errors.print(f"cluster-est: {text}", soft_wrap=True)


class PrintedAnswer(Answer):
    """Prints what is said at once, on standard output."""

    def __init__(self) -> None:
        super().__init__()
        self._console = Console(markup=False, highlight=False, emoji=False)

    @override
    def say(self, text: str) -> None:
        self._console.print(text, soft_wrap=True)

    @override
    def tell(self, text: str) -> None:
        width = self._console.width
        if self._console.is_terminal and len(text) > width:
            text = textwrap.fill(
                text,
                width,
                subsequent_indent=" " * (len(text) - len(text.lstrip()) + 4),
                break_long_words=False,
                break_on_hyphens=False,
            )
        self.say(text)

    @override
    def table(self, header: list[str], rows: Iterable[Iterable[str]]) -> None:
        lines = [header, *([*row] for row in rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        self.say("")
        for line in lines:
            cells = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
            self.say("  ".join(cells).rstrip())


class DocumentAnswer(Answer):
    """Keeps what is said, for a document that is written when the command has ended."""

    @override
    def say(self, text: str) -> None:
        if text.strip():
            one_line = "\n" not in text.strip()
            self.sentences.append(" ".join(text.split()) if one_line else text.strip("\n"))

    @override
    def tell(self, text: str) -> None:
        self.say(text)

    @override
    def table(self, header: list[str], rows: Iterable[Iterable[str]]) -> None:
        """Say nothing: the document has the numbers themselves."""
