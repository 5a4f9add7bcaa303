"""Effects that the model lacked: equations, coefficients, curves over the range of the data."""

from __future__ import annotations

from typing import Any

import numpy as np

from cluster_est.closed_loop.screening.evidence import CandidateStage
from cluster_est.report.blocks import (
    Block,
    FigureBlock,
    ItemsBlock,
    ReportSection,
    SourceBlock,
    TableBlock,
    TableCell,
    TextBlock,
    axis,
    cells,
    columns,
    with_unit,
)
from cluster_est.report.encode import short
from cluster_est.report.folder import ReportedRun, Row
from cluster_est.report.numbers import beside, digits, interval

MARGIN = 1.5
"""Heights of a curve by which its band may be drawn beyond it: a wide one would hide it."""


def effects(run: ReportedRun) -> ReportSection:
    """Make the section of the effects that were added, or of those that did not pass."""
    blocks: list[Block] = []
    for effect in run.facts.get("effects") or []:
        blocks += _effect(run, effect)
    rejected = run.facts.get("rejected") or []
    if rejected:
        blocks.append(
            TextBlock(
                "Not accepted; what follows shows where to look, not what is missing.", "faint"
            )
        )
        rows = [
            cells(TableCell(e["site"], code=True), e["form"], TableCell(e["equation"], code=True))
            for e in rejected
        ]
        blocks.append(TableBlock(columns("site", "form", "equation"), tuple(rows)))
    return ReportSection("effects", "What the model lacked", tuple(blocks))


def _effect(run: ReportedRun, effect: Row) -> list[Block]:
    names = columns("coefficient", "#value", "#95 % interval", "unit", "")
    rows = []
    for name, row in effect["parameters"].items():
        low, high = row["lower95"], row["upper95"]
        width = high - low if low is not None and high is not None else 0.0
        said = "held" if row["fixed"] else "not determined" if low is None else ""
        rows.append(
            cells(
                TableCell(name, code=True),
                beside(row["value"], width),
                interval(low, high),
                row["unit"],
                TableCell(said, "faint"),
            )
        )
    blocks: list[Block] = [
        TextBlock(f"{effect['name']}: {_words(effect)} at {effect['site']}", kind="heading"),
        TextBlock(effect["equation"], kind="equation"),
        *([TextBlock(effect["sentence"])] if effect.get("sentence") else []),
        TableBlock(names, tuple(rows)),
    ]
    evidence = tuple(effect.get("evidence") or ())
    blocks += [ItemsBlock(evidence)] if evidence else []
    shapes = [row for row in run.tables["shapes"] if row["effect"] == effect["name"]]
    blocks += [_curve(row, i) for i, row in enumerate(shapes) if not row["why_not"]]
    blocks += [TextBlock(f"No shape is drawn: {row['why_not']}.", "faint")
               for row in shapes if row["why_not"]]  # fmt: skip
    if not shapes:
        blocks.append(TextBlock("This run's folder holds no shapes to draw.", "faint"))
    blocks.append(SourceBlock("As a block for a config", effect["config"]))
    return blocks


def _words(effect: Row) -> str:
    """Its name; runs of earlier versions have only that of a family."""
    return str(effect.get("words") or effect["family"])


def _curve(row: Row, number: int) -> FigureBlock:
    x, y, low, high = (np.array(row[name], float) for name in ("x", "y", "lower", "upper"))
    traces: list[dict[str, Any]] = []
    height = float(np.nanmax(y) - np.nanmin(y)) or abs(float(y[0])) or 1.0
    floor, ceiling = float(np.nanmin(y)) - MARGIN * height, float(np.nanmax(y)) + MARGIN * height
    known = bool(np.isfinite(low).all() and np.isfinite(high).all())
    wide = known and bool((low < floor).any() or (high > ceiling).any())
    if known:
        hidden = {"mode": "lines", "line": {"width": 0}, "x": short(x), "hoverinfo": "skip"}
        low, high = np.clip(low, floor, ceiling), np.clip(high, floor, ceiling)
        traces.append({**hidden, "y": short(low), "showlegend": False})
        name = "95 % band, cut off" if wide else "95 % band"
        traces.append({**hidden, "y": short(high), "fill": "tonexty", "fillcolor": "$band",
                       "name": name})  # fmt: skip
    line = {"color": "$after", "width": 2}
    traces.append({"x": short(x), "y": short(y), "mode": "lines", "line": line, "name": "effect"})
    edges = np.array(row["edges"], float)
    middles, width = 0.5 * (edges[1:] + edges[:-1]), float(edges[1] - edges[0])
    bars = {"type": "bar", "x": short(middles), "y": row["counts"], "width": width, "yaxis": "y2"}
    traces.append({**bars, "marker": {"color": "$faint"}, "name": "samples", "showlegend": False})
    over = with_unit(row["variable"], row["variable_unit"])
    layout = {
        "xaxis": axis(over, anchor="y2"),
        "yaxis": axis(with_unit(row["part"], row["unit"]), domain=[0.3, 1.0]),
        "yaxis2": axis("samples", domain=[0.0, 0.2], anchor="x", nticks=3),
        "bargap": 0,
    }
    title = f"{row['part']} over {over}, where the training data were"
    if not known:
        title += "; the data do not determine every coefficient, so there is no band"
    return FigureBlock(f"shape-{row['effect']}-{number}", title, traces, layout, 320)


def candidates(run: ReportedRun) -> ReportSection:
    """Make the section of the candidates, ranked, and of those that cannot be told apart."""
    rows = run.tables["findings"]
    blocks: list[Block] = [_rivals(effect) for effect in run.facts.get("effects") or []]
    if rows:
        blocks.insert(
            0,
            TextBlock(
                "Each step ranks everything that could be missing by how well it points along the "
                "residual. Explained is the share of the residual's squares that its direction "
                "carries; the criterion is that of its refit less that of the model without it, "
                "where it was refitted (lower is better)."
            ),
        )
    for step in sorted({row["step"] for row in rows}):
        own = sorted((row for row in rows if row["step"] == step), key=_rank)
        blocks.append(_ranked(step, own))
    blocks += _compared(run)
    return ReportSection("candidates", "Candidates", tuple(blocks))


def _compared(run: ReportedRun) -> list[Block]:
    """The structures that each step refitted, the best first."""
    names = columns("structure", "#gap closed", "#criterion", "")
    blocks: list[Block] = []
    for step in sorted({row["step"] for row in run.tables["structures"]}):
        own = [row for row in run.tables["structures"] if row["step"] == step]
        lines = [
            cells(
                TableCell(" + ".join(row["effects"]), code=True),
                f"{100.0 * row['closed']:.1f}\u2009%",
                digits(row["criterion"], 4),
                TableCell("accepted", "good") if row["accepted"]
                else TableCell("" if row["converged"] else "fell behind", "faint"),
            )
            for row in own
        ]  # fmt: skip
        caption = f"Step {step}: {len(own)} sets of effects refitted"
        blocks.append(TableBlock(names, tuple(lines), caption, folded=True))
    return blocks


STAGES = tuple(reversed(CandidateStage))
"""The furthest first."""


def _rank(row: Row) -> tuple[int, float, float]:
    stage = row["stage"]
    place = STAGES.index(stage) if stage in STAGES else len(STAGES)
    criterion = row["criterion"]
    return place, 0.0 if criterion is None or criterion != criterion else criterion, row["log_p"]


def _ranked(step: int, rows: list[Row]) -> TableBlock:
    names = columns("site", "form", "of", "stage", "#explained", "#log₁₀ p", "#criterion", "")
    lines = [
        cells(
            TableCell(row["site"], code=True),
            row["form"],
            TableCell(", ".join(row["variables"] or ()), code=True),
            TableCell(row["stage"], "good" if row["stage"] == CandidateStage.ACCEPTED else ""),
            f"{100.0 * row['explained']:.1f}\u2009%",
            digits(row["log_p"] / np.log(10.0), 4),
            digits(row["criterion"], 4),
            TableCell(_confounded(row["imitated_by"]), "faint"),
        )
        for row in rows
    ]
    return TableBlock(names, tuple(lines), f"Step {step}: {len(rows)} candidates", folded=True)


def _confounded(parameter: str) -> str:
    return f"confounded with {parameter}" if parameter else ""


def _rivals(effect: Row) -> Block:
    others = effect.get("alternatives") or []
    if not others:
        return TextBlock(
            f"{effect['name']}: nothing else that was tried explains the data as well."
        )
    names = columns("cannot be told apart", "equation", "#criterion", "differ most at", "#by")
    chosen = cells(
        TableCell(f"{effect.get('words') or effect['form']} at {effect['site']} (chosen)"),
        TableCell(effect["equation"], code=True), "0", "", "",
    )  # fmt: skip
    lines = [chosen]
    for other in others:
        at, by = "", ""
        if other["experiment"] and other["time"] is not None and other["difference"] is not None:
            at = f"{other['output']} of {other['experiment']}, {digits(other['time'])} s"
            by = f"{digits(other['difference'], 2)} times the noise"
        criterion = other["criterion"]
        lines.append(
            cells(
                f"{other.get('words') or other['form']} at {other['site']}",
                TableCell(other["equation"], code=True),
                "" if criterion is None else ("+" if criterion >= 0 else "") + digits(criterion, 3),
                at,
                by,
            )
        )
    return TableBlock(
        names, tuple(lines), f"{effect['name']}: {len(lines)} that explain the data alike"
    )
