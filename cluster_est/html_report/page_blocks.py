"""Blocks of a section; the template has a part for each kind of block."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from cluster_est.html_report.charts import Chart

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
    """A column of a table; `numeric` columns are aligned to the right."""

    name: str
    numeric: bool = False


@dataclass(frozen=True)
class TableCell:
    """A cell of a table; with `code`, in a fixed-width font for FMU names and equations.

    `more` is written below it, and `link` is the target of a click on it.
    """

    text: str
    tone: Tone = ""
    code: bool = False
    more: str = ""
    link: str = ""


TableLine = tuple[str | TableCell, ...]


@dataclass(frozen=True)
class TableBlock:
    """A table; a `folded` table opens with a click on its `caption`, otherwise above it."""

    columns: tuple[ReportColumn, ...]
    rows: tuple[tuple[TableCell, ...], ...]
    caption: str = ""
    folded: bool = False
    kind: str = "table"


@dataclass(frozen=True)
class FigureBlock:
    """A chart with its title; `note` explains how to read it."""

    id: str
    title: str
    chart: Chart = field(repr=False)
    note: str = ""
    kind: str = "figure"


@dataclass(frozen=True)
class GridBlock:
    """Small figures side by side."""

    figures: tuple[FigureBlock, ...]
    kind: str = "grid"


@dataclass(frozen=True)
class NextStep:
    """A next step, with the command that performs it."""

    text: str
    command: str = ""


@dataclass(frozen=True)
class CurvePanel:
    """The curves of one output of one experiment.

    Attributes
    ----------
    experiment, output
        Names of the experiment and the output.
    note
        Text after these names: the role of the experiment and its errors.
    chart
        Inputs, measured and simulated output, and the residuals below.
    """

    experiment: str
    output: str
    note: str
    chart: Chart = field(repr=False)


@dataclass(frozen=True)
class PanelsBlock:
    """Curves of many experiments as small charts, which the reader may enlarge.

    `curves` contains the name and the ink of each curve in them.
    """

    panels: tuple[CurvePanel, ...]
    curves: tuple[tuple[str, str], ...]
    kind: str = "panels"

    @property
    def experiments(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(panel.experiment for panel in self.panels))


@dataclass(frozen=True)
class MapCell:
    """A cell of a map: from -1 to 1, None if empty; `text` is shown if there is space."""

    value: float | None
    text: str = ""
    title: str = ""


@dataclass(frozen=True)
class MapBlock:
    """Numbers from -1 to 1 as a table of coloured cells, with names at its sides."""

    title: str
    above: tuple[str, ...]
    rows: tuple[tuple[str, tuple[MapCell, ...]], ...]
    note: str = ""
    kind: str = "map"


@dataclass(frozen=True)
class SourceBlock:
    """The text of a file, folded."""

    title: str
    text: str
    kind: str = "source"


Block = (
    TextBlock
    | ItemsBlock
    | TableBlock
    | FigureBlock
    | GridBlock
    | PanelsBlock
    | MapBlock
    | SourceBlock
)


@dataclass(frozen=True)
class ReportSection:
    """A section of the page; it is not shown if it has no blocks."""

    id: str
    title: str
    blocks: tuple[Block, ...]


def table(
    names: Sequence[str], rows: Iterable[TableLine], caption: str = "", *, folded: bool = False
) -> TableBlock:
    """Return a table; a column "#name" is numeric, and a text becomes a plain cell."""
    columns = tuple(ReportColumn(name.removeprefix("#"), name.startswith("#")) for name in names)
    cells = (
        tuple(each if isinstance(each, TableCell) else TableCell(each) for each in row)
        for row in rows
    )
    return TableBlock(columns, tuple(cells), caption, folded)


def code(text: str) -> TableCell:
    """Return a cell with a name of the FMU, or an equation."""
    return TableCell(text, code=True)


def with_unit(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit, if known."""
    return f"{name} ({unit})" if unit else name
