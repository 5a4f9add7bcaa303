"""Charts of a report, read back from the page: scales, paths and the values that they show."""

import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

UNITS = 10_000


@dataclass
class DrawnPlot:
    """A plot: its label for those who do not see it, its scales, and the paths of its marks."""

    title: str
    x: str
    y: str
    paths: dict[str, list[str]] = field(default_factory=dict)

    def curve(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The values of a mark by its name, as the page shows them."""
        (path,) = self.paths[name]
        across, down = points(path)
        return value(self.x, across), value(self.y, UNITS - down)

    def by_row(self, name: str, count: int) -> tuple[np.ndarray, list[int]]:
        """The values across of a mark in a plot of so many rows, and the rows, from above."""
        (path,) = self.paths[name]
        across, down = points(path)
        return value(self.x, across), np.rint(down / UNITS * count - 0.5).astype(int).tolist()

    def grain(self, scale: str) -> float:
        """Half of what one place is worth, and a little."""
        low, high = map(float, scale.split()[:2])
        return 0.51 * abs(high - low) / UNITS


@dataclass
class DrawnFigure:
    """A figure: its attributes, its plots and its texts."""

    attributes: dict[str, str | None]
    plots: list[DrawnPlot] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)


class Figures(HTMLParser):
    """All figures of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.found: list[DrawnFigure] = []
        self.svgs: list[dict[str, str | None]] = []
        self.titles = 0
        self.in_figure = False
        self.feed(path.read_text(encoding="utf-8"))

    def by_id(self, name: str) -> DrawnFigure:
        (found,) = [each for each in self.found if each.attributes.get("id") == name]
        return found

    @property
    def panels(self) -> list[DrawnFigure]:
        """Those of the experiments."""
        return [each for each in self.found if "data-experiment" in each.attributes]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        if tag == "figure":
            self.found.append(DrawnFigure(known))
            self.in_figure = True
        elif tag == "div" and known.get("class") == "plot":
            self.found[-1].plots.append(DrawnPlot("", known["data-x"] or "", known["data-y"] or ""))
        elif tag == "svg":
            self.svgs.append(known)
            self.found[-1].plots[-1].title = known["aria-label"] or ""
        elif tag == "title" and self.in_figure:
            self.titles += 1
        elif tag == "path" and "data-name" in known:
            paths = self.found[-1].plots[-1].paths
            paths.setdefault(known["data-name"] or "", []).append(known["d"] or "")

    def handle_endtag(self, tag: str) -> None:
        self.in_figure = self.in_figure and tag != "figure"

    def handle_data(self, data: str) -> None:
        if self.in_figure and data.strip():
            self.found[-1].texts.append(data.strip())


def points(path: str) -> tuple[np.ndarray, np.ndarray]:
    """The places of a path: across, and down from above."""
    found: list[tuple[int, int]] = []
    for part in path.split("M")[1:]:
        if part.endswith("h0"):
            part = part.removesuffix("h0")
        numbers = [int(number) for number in re.findall(r"-?\d+", part)]
        steps = np.array(numbers).reshape(-1, 2)
        found += np.cumsum(steps, axis=0).tolist()
    across, down = np.array(found, float).T
    return across, down


def value(scale: str, places: np.ndarray) -> np.ndarray:
    """The values at places of a scale as the page writes it."""
    low, high, *log = scale.split()
    share = places / UNITS
    if log:
        return float(low) * (float(high) / float(low)) ** share
    return float(low) + (float(high) - float(low)) * share
