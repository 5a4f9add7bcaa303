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
    """A column of a table; `numeric` ones are aligned to the right."""

    name: str
    numeric: bool = False


@dataclass(frozen=True)
class TableCell:
    """`code` is set in a fixed width, for names of the FMU and equations.

    `more` stands below it, and `link` is where a click on it leads.
    """

    text: str
    tone: Tone = ""
    code: bool = False
    more: str = ""
    link: str = ""


TableLine = tuple[str | TableCell, ...]


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
    """A chart under its title; `note` says how to read it."""

    id: str
    title: str
    chart: Chart = field(repr=False)
    note: str = ""
    kind: str = "figure"


@dataclass(frozen=True)
class GridBlock:
    """Small figures beside each other."""

    figures: tuple[FigureBlock, ...]
    kind: str = "grid"


@dataclass(frozen=True)
class NextStep:
    """What to do next, with the command that does it."""

    text: str
    command: str = ""


@dataclass(frozen=True)
class CurvePanel:
    """The curves of one output of one experiment.

    Attributes
    ----------
    experiment, output
        Whose curves.
    note
        What stands behind these names: the role of the experiment and its errors.
    chart
        What was fed in, measured and simulated, and the residuals below.
    """

    experiment: str
    output: str
    note: str
    chart: Chart = field(repr=False)


@dataclass(frozen=True)
class PanelsBlock:
    """Curves of many experiments as small charts, of which the reader enlarges those of interest.

    `curves` has the name and the ink of each curve that is drawn in them.
    """

    panels: tuple[CurvePanel, ...]
    curves: tuple[tuple[str, str], ...]
    kind: str = "panels"

    @property
    def experiments(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(panel.experiment for panel in self.panels))


@dataclass(frozen=True)
class MapCell:
    """A cell of a map: from -1 to 1, None for nothing; `text` is shown where there is room."""

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
    """A text as it stands in a file, folded."""

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
    """A part of the page; nothing of it is shown where it has no blocks."""

    id: str
    title: str
    blocks: tuple[Block, ...]


def table(
    names: Sequence[str], rows: Iterable[TableLine], caption: str = "", *, folded: bool = False
) -> TableBlock:
    """A table; the column "#name" is a numeric one, and a text is a plain cell."""
    columns = tuple(ReportColumn(name.removeprefix("#"), name.startswith("#")) for name in names)
    cells = (
        tuple(each if isinstance(each, TableCell) else TableCell(each) for each in row)
        for row in rows
    )
    return TableBlock(columns, tuple(cells), caption, folded)


def code(text: str) -> TableCell:
    """A cell with a name of the FMU, or an equation."""
    return TableCell(text, code=True)


def with_unit(name: str, unit: str) -> str:
    """The name of a quantity with its unit, where that is known."""
    return f"{name} ({unit})" if unit else name
