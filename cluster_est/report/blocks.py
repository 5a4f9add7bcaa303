"""Blocks of a section; the template has a part for each kind of block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Tone = Literal["", "good", "bad", "faint"]


@dataclass(frozen=True)
class TextBlock:
    """A paragraph."""

    text: str
    tone: Tone = ""
    kind: str = "text"


@dataclass(frozen=True)
class ItemsBlock:
    """Sentences below each other."""

    items: tuple[str, ...]
    kind: str = "items"


@dataclass(frozen=True)
class ReportColumn:
    """A column of a table; `numeric` ones are aligned to the right."""

    name: str
    numeric: bool = False


@dataclass(frozen=True)
class TableCell:
    """`code` is set in a fixed width, for names of the FMU and equations."""

    text: str
    tone: Tone = ""
    code: bool = False


@dataclass(frozen=True)
class TableBlock:
    """`folded` ones open with a click; `caption` stands above, or on what is clicked."""

    columns: tuple[ReportColumn, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    caption: str = ""
    folded: bool = False
    kind: str = "table"


@dataclass(frozen=True)
class FigureBlock:
    """A plot: traces and layout as Plotly takes them, drawn when it comes into view.

    A text "$name" in them stands for a colour of the page's theme.
    """

    id: str
    title: str
    traces: Sequence[Mapping[str, Any]] = field(repr=False)
    layout: Mapping[str, Any] = field(repr=False)
    height: int = 320
    kind: str = "figure"


@dataclass(frozen=True)
class ExplorerBlock:
    """The curves of all experiments, of which one is shown; `curves` is read by the script."""

    experiments: Sequence[Mapping[str, Any]] = field(repr=False)
    kind: str = "explorer"


@dataclass(frozen=True)
class SourceBlock:
    """A text as it stands in a file, folded."""

    title: str
    text: str
    kind: str = "source"


Block = TextBlock | ItemsBlock | TableBlock | FigureBlock | ExplorerBlock | SourceBlock


@dataclass(frozen=True)
class ReportSection:
    """A part of the page; nothing of it is shown where it has no blocks."""

    id: str
    title: str
    blocks: tuple[Block, ...]


def columns(*names: str) -> tuple[ReportColumn, ...]:
    """Columns by their names; "#name" is a numeric one."""
    return tuple(ReportColumn(name.removeprefix("#"), name.startswith("#")) for name in names)


def cells(*texts: str | TableCell) -> tuple[TableCell, ...]:
    """A row."""
    return tuple(text if isinstance(text, TableCell) else TableCell(text) for text in texts)


def plain(text: str) -> str:
    """A text for Plotly, which takes some tags for formatting."""
    return text.replace("&", "&amp;").replace("<", "&lt;")


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with a title that may come from a file."""
    return {"title": {"text": plain(title)}, **more}


def with_unit(name: str, unit: str) -> str:
    """The name of a quantity with its unit, where that is known."""
    return f"{name} ({unit})" if unit else name
