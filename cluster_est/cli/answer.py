"""The output of a command: sentences and tables, or one JSON document for programs.

A command passes sentences, tables and the fields of its document to its answer, independent of the
format. `cluster_est.cli.document` declares the fields.
"""

from __future__ import annotations

import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console
from rich.table import Table
from typing_extensions import override

Cell = Callable[[dict[str, Any]], str]
"""Function that returns the text of a column in a row."""


class Answer(ABC):
    """The answer of one command.

    Attributes
    ----------
    found
        Fields of its document, as declared in `cluster_est.cli.document`.
    sentences, complaints
        Sentences so far, on standard output and on standard error.
    """

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}
        self.sentences: list[str] = []
        self.complaints: list[str] = []

    def add(self, **found: Any) -> None:
        """Add fields of the document."""
        self.found |= found

    def complain(self, text: str) -> None:
        """Print a sentence on standard error, with the program's name."""
        self.complaints.append(text)
        _print_error(text)

    def fail(self, text: str) -> None:
        """Print why there is no answer."""
        self.add(message=text)
        _print_error(text)

    def rows(self, rows: Iterable[dict[str, Any]], *columns: tuple[str, str | Cell]) -> None:
        """Print a table; a column has a name, and a key of the rows or a function for its cells."""
        self.table(
            [name for name, _ in columns],
            [[str(r[of]) if isinstance(of, str) else of(r) for _, of in columns] for r in rows],
        )

    @abstractmethod
    def say(self, text: str) -> None:
        """Print one line without breaks."""

    @abstractmethod
    def tell(self, text: str) -> None:
        """Print a sentence, with line breaks only in a terminal."""

    @abstractmethod
    def table(
        self, header: list[str], rows: Iterable[Iterable[str]], *, fitted: bool = False
    ) -> None:
        """Print a table without rules; a document contains its numbers in a field instead.

        `fitted` breaks the text in its cells, so that the table fits into the terminal.
        """


def _print_error(text: str) -> None:
    errors = Console(stderr=True, markup=False, highlight=False, emoji=False)
    errors.print(f"cluster-est: {text}", soft_wrap=True)


class PrintedAnswer(Answer):
    """Prints everything at once on standard output."""

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
    def table(
        self, header: list[str], rows: Iterable[Iterable[str]], *, fitted: bool = False
    ) -> None:
        if fitted:
            grid = Table(*header, box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="")
            grid.columns[0].no_wrap = True
            for row in rows:
                grid.add_row(*row)
            self.say("")
            self._console.print(grid)
            return
        lines = [header, *([*row] for row in rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        self.say("")
        for line in lines:
            cells = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
            self.say("  ".join(cells).rstrip())


class DocumentAnswer(Answer):
    """Collects sentences for a document that is written at the end of the command."""

    @override
    def say(self, text: str) -> None:
        if text.strip():
            one_line = "\n" not in text.strip()
            self.sentences.append(" ".join(text.split()) if one_line else text.strip("\n"))

    @override
    def tell(self, text: str) -> None:
        self.say(text)

    @override
    def table(
        self, header: list[str], rows: Iterable[Iterable[str]], *, fitted: bool = False
    ) -> None:
        """Print nothing, because the document contains the numbers."""
