"""The picture of the page on clusters: who is where in a run, and what goes between them."""

from __future__ import annotations

from dataclasses import dataclass

from docs.svg import document, lines, text

from cluster_est.executors.backlog import BATCH_SECONDS

WIDTH, HEIGHT = 860, 572

STYLE = """
.box { fill: var(--fill); stroke: var(--edge); }
.part { fill: var(--page); stroke: var(--edge); }
.lost { stroke: var(--c1); stroke-width: 1.6; stroke-dasharray: 6 4; }
.arrow { stroke: var(--edge); stroke-width: 1.6; fill: none; }
.tip { fill: var(--edge); }
.again { stroke: var(--c1); stroke-dasharray: 6 4; }
.againtip { fill: var(--c1); }
"""

TIPS = "".join(
    f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
    f'orient="auto-start-reverse"><path class="{name}" d="M0 0L8 4L0 8z"/></marker>'
    for name in ("tip", "againtip")
)


@dataclass(frozen=True)
class Box:
    """A named rectangle: its left upper corner and its size in pixels."""

    x: float
    y: float
    width: float
    height: float

    def drawn(self, head: str, words: tuple[str, ...] = (), kind: str = "box") -> list[str]:
        """The rectangle with its name and what it says."""
        return [
            f'<rect class="{kind}" x="{self.x}" y="{self.y}" width="{self.width}" '
            f'height="{self.height}" rx="6"/>',
            *([text(self.x + 12, self.y + 22, head, "head")] if head else []),
            *lines(self.x + 12, self.y + (41 if head else 20), words),
        ]


def picture() -> str:
    """The coordinator, the nodes with their actors, and what is sent, as SVG."""
    parts = [f"<defs>{TIPS}</defs>", *coordinator(), *nodes(), *sent()]
    title = "A run on a cluster: one coordinator, nodes with Ray actors, and what is sent"
    return document((WIDTH, HEIGHT), title, STYLE, parts)


def coordinator() -> list[str]:
    """The one process that decides everything, and the folder that it writes."""
    asked = ("asks for points and gets", "their evaluations")
    queued = (
        "a task is a point in one",
        "experiment; outcomes are put",
        "in the order of experiments,",
        "not in that of their arrival",
    )
    kept = (
        "on the coordinator's disk.",
        "Log (Arrow): every outcome,",
        "as soon as it arrives.",
        "At the end: tables (Parquet)",
        "and the report.",
        "If the coordinator dies,",
        "--resume goes on from the log",
    )
    return [
        *Box(20, 20, 250, 532).drawn("Coordinator", ("one process, on the head node",)),
        *Box(36, 80, 218, 68).drawn("Method", asked, "part"),
        *Box(36, 202, 218, 122).drawn("Queue", queued, "part"),
        *Box(36, 378, 218, 158).drawn("Run folder", kept, "part"),
        _arrow("M112 148V198"),
        text(104, 178, "points", anchor="end"),
        _arrow("M158 202V152"),
        text(166, 178, "evaluations"),
        _arrow("M135 324V374"),
        text(143, 354, "outcomes"),
    ]


def nodes() -> list[str]:
    """The machines that simulate, one of which is gone."""
    unpacked = ("its cache folder has the FMU, unpacked once",)
    parts = Box(500, 20, 340, 218).drawn("Node 1", unpacked)
    process = ("process with the", "loaded FMU; if it", "crashes or hangs,", "it is replaced")
    for left in (516, 678):
        parts += Box(left, 78, 146, 144).drawn("Ray actor", ("one for each core",), "part")
        parts += Box(left + 8, 128, 130, 86).drawn("", process)
    parts += Box(500, 254, 340, 108).drawn("Node 2", ("nodes may join during the fit",))
    for left in (516, 622, 728):
        parts += Box(left, 312, 96, 36).drawn("Ray actor", (), "part")
    lost = (
        "What it had not finished is simulated by others,",
        "with the same bits. The queue and the run folder",
        "are with the coordinator: nothing else is lost.",
    )
    return [*parts, *Box(500, 402, 340, 96).drawn("Node 3 is lost", lost, "box lost")]


def sent() -> list[str]:
    """What goes from the coordinator to the nodes and back."""
    return [
        *lines(284, 44, ("once, by Ray's object store:", "FMU and experiments")),
        _arrow("M270 70H496"),
        *lines(
            284, 112, ("tasks, in batches of about", f"{BATCH_SECONDS:g} s, two for each actor")
        ),
        _arrow("M270 138H496"),
        *lines(284, 180, ("outcomes: residuals, or one", "number for each output")),
        _arrow("M500 206H274"),
        text(284, 266, "the same to every node"),
        _arrow("M270 274H496"),
        _arrow("M500 294H274"),
        _arrow("M500 440H300V312H258", "arrow again", "againtip"),
        *lines(312, 462, ("tasks that have no outcome", "go back, first in the queue")),
    ]


def _arrow(path: str, kind: str = "arrow", tip: str = "tip") -> str:
    return f'<path class="{kind}" d="{path}" marker-end="url(#{tip})"/>'
