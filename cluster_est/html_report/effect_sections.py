"""Effects that the model lacked: equations, coefficients, and curves over the range of the data."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.settings import CandidateStage
from cluster_est.html_report.charts import (
    Band,
    Bars,
    Chart,
    Dots,
    ErrorBars,
    Line,
    Mark,
    Plot,
)
from cluster_est.html_report.number_text import beside, digits, interval
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    ItemsBlock,
    ReportSection,
    SourceBlock,
    TableBlock,
    TableCell,
    TableLine,
    TextBlock,
    code,
    table,
    with_unit,
)
from cluster_est.html_report.reported_run import ReportedRun, Row, other_laws
from cluster_est.html_report.scales import Scale
from cluster_est.problem.display import BETTER, NO_ALTERNATIVE, in_percent, percent
from workers.messages import FloatArray

BAND_MARGIN = 1.5
"""Largest width of a band relative to the height of its curve; a wider band would hide it."""
EVIDENCE = (
    "The dots are estimates at a few points, from the residuals alone and without an assumed form; "
    "their error bars are 95 % intervals. The line is the fitted effect. If the dots lie on the "
    "line, the data agree with its shape. "
)
RANGE = (
    "The bars below the curve count the samples of the training experiments; beyond these bars, "
    "the line is extrapolated."
)


def shape_figure(row: Row, number: int) -> FigureBlock:
    """Draw one row of shapes.parquet: the effect, its band, its evidence and its samples."""
    x, y, low, high = (np.array(row[name], float) for name in ("x", "y", "lower", "upper"))
    height = float(np.nanmax(y) - np.nanmin(y)) or abs(float(y[0])) or 1.0
    floor, ceiling = (
        float(np.nanmin(y)) - BAND_MARGIN * height,
        float(np.nanmax(y)) + BAND_MARGIN * height,
    )
    known = bool(np.isfinite(low).all() and np.isfinite(high).all())
    marks: list[Mark] = []
    if known:
        wide = bool((low < floor).any() or (high > ceiling).any())
        low, high = np.clip(low, floor, ceiling), np.clip(high, floor, ceiling)
        name = "95 % band, cut off" if wide else "95 % band"
        marks.append(Band(name, "after", x, low, high))
    marks.append(Line("effect", "after", x, y))
    evidence, seen = _evidence(row, floor, ceiling)
    marks += evidence
    over = with_unit(row["variable"], row["variable_unit"])
    edges, counts = np.array(row["edges"], float), np.array(row["counts"], float)
    across, label = Scale.around(edges, margin=0.01), with_unit(row["part"], row["unit"])
    title = f"{row['part']} over {over}, in the range of the training data"
    if not len(edges):  # the response of a filter, over time or frequency
        across, title = Scale.around(x, margin=0.01, may_be_log=True), f"{label} over {over}"
    if not known:
        title += "; the data do not determine every coefficient, so there is no band"
    upright = Scale.around(y, low[np.isfinite(low)], high[np.isfinite(high)], seen)
    plots = [Plot(title, label, across, upright, marks, 230)]
    note = EVIDENCE if evidence else ""
    if len(edges):
        samples = Scale(0.0, 1.08 * float(counts.max()) or 1.0)
        bars = Bars("", "faint", edges, counts)
        plots.append(Plot(f"samples over {over}", "samples", across, samples, [bars], 60))
        note += RANGE
    return FigureBlock(f"shape-{row['effect']}-{number}", title, Chart(tuple(plots), over), note)


def _evidence(row: Row, floor: float, ceiling: float) -> tuple[list[Mark], FloatArray]:
    """Return the estimates from the residuals alone, with their error bars, if the run has them."""
    at, free, error = (
        np.array(row.get(name) or (), float) for name in ("free_x", "free_y", "free_error")
    )
    some = np.isfinite(at) & np.isfinite(free) & (free >= floor) & (free <= ceiling)
    if not some.any():
        return [], np.zeros(0)
    at, free, spread = at[some], free[some], 1.96 * error[some]
    low, high = np.maximum(free - spread, floor), np.minimum(free + spread, ceiling)
    marks = [
        ErrorBars("", "measured", at, low, high),
        Dots("estimate from the residuals", "measured", at, free),
    ]
    return [*marks], np.concatenate([low, high])


def _lead(run: ReportedRun) -> Row | None:
    """Return the shape for the head of the page: that of the first effect found."""
    found = {effect["name"] for effect in run.facts.get("effects") or []}
    drawn = (row for row in run.tables["shapes"] if row["effect"] in found and not row["why_not"])
    return next(drawn, None)


def lead_shape(run: ReportedRun) -> list[FigureBlock]:
    """Return the picture of the effect found, for the head of a page."""
    lead = _lead(run)
    return [] if lead is None else [shape_figure(lead, 0)]


def effect_words(run: ReportedRun) -> list[Block]:
    """Return the equation of each effect found, and its values."""
    blocks: list[Block] = []
    for effect in run.facts.get("effects") or []:
        blocks.append(TextBlock(effect["equation"], kind="equation"))
        _, _, values = effect["sentence"].partition(effect["equation"])
        values = values.lstrip(",; ")
        blocks.append(TextBlock(values[:1].upper() + values[1:] or effect["sentence"]))
        if effect.get("claim"):
            blocks.append(_how_sure(effect))
    return blocks


def _how_sure(effect: Row) -> TextBlock:
    """Return how often such claims or leads were correct in the benchmark."""
    said = effect["claim"]["sentence"]
    return TextBlock(f"{said[:1].upper()}{said[1:]}.")


def sure_words(run: ReportedRun) -> list[Block]:
    """Return how probable the effects are among rivals, and how often they are chosen again."""
    said = [run.facts[key] for key in ("likely", "resampled") if run.facts.get(key)]
    return [TextBlock(f"{each[:1].upper()}{each[1:]}.") for each in said]


COEFFICIENTS = ("coefficient", "#value", "#95 % interval", "unit", "")


def effects(run: ReportedRun) -> ReportSection:
    """Return the section of the effects that were added, or of those that were rejected."""
    blocks: list[Block] = []
    for effect in run.facts.get("effects") or []:
        blocks += _effect(run, effect)
    found = {effect["name"] for effect in run.facts.get("effects") or []}
    shapes = [row for row in run.tables["shapes"] if row["effect"] not in found]
    for name in dict.fromkeys(row["effect"] for row in shapes):
        blocks += _declared(run, name, [row for row in shapes if row["effect"] == name])
    rejected = run.facts.get("rejected") or []
    if rejected:
        blocks.append(
            TextBlock(
                "Not accepted: these effects show where to look, not what is missing.", "faint"
            )
        )
        claim = rejected[0].get("claim")
        if claim and claim["sentence"] not in (run.facts.get("summary") or ""):
            blocks.append(_how_sure(rejected[0]))
        rows = [(code(e["site"]), e["form"], code(e["equation"])) for e in rejected]
        blocks.append(table(("site", "form", "equation"), rows))
        blocks += [_rivals(each) for each in rejected if other_laws(each)]
    title = "Missing effects" if run.is_loop else "Declared effects"
    return ReportSection("effects", title, tuple(blocks))


def _effect(run: ReportedRun, effect: Row) -> list[Block]:
    rows = []
    for name, row in effect["parameters"].items():
        low, high = row["lower95"], row["upper95"]
        width = high - low if low is not None and high is not None else 0.0
        said = "held" if row["fixed"] else "not determined" if low is None else ""
        if row["at_bound"]:
            said = f"at its {row['at_bound']} bound"
        numbers = beside(row["value"], width), interval(low, high)
        rows.append((code(name), *numbers, row["unit"], TableCell(said, "faint")))
    blocks: list[Block] = [
        TextBlock(f"{effect['name']}: {effect['words']} at {effect['site']}", kind="heading"),
        table(COEFFICIENTS, rows),
    ]
    evidence = tuple(effect.get("evidence") or ())
    blocks += [ItemsBlock(evidence)] if evidence else []
    shapes = [row for row in run.tables["shapes"] if row["effect"] == effect["name"]]
    blocks += _shapes(shapes, _lead(run))
    if not shapes:
        blocks.append(
            TextBlock("The folder of this run contains no curve of this effect.", "faint")
        )
    blocks.append(SourceBlock("Block for a config", effect["config"]))
    return blocks


def _shapes(rows: Sequence[Row], lead: Row | None = None) -> list[Block]:
    """Return the shapes of one effect except that at the head, or why they are missing."""
    blocks: list[Block] = [
        shape_figure(row, i) for i, row in enumerate(rows) if not row["why_not"] and row is not lead
    ]
    missing = dict.fromkeys(row["why_not"] for row in rows if row["why_not"])
    return [*blocks, *(TextBlock(f"No curve is drawn: {why}.", "faint") for why in missing)]


def _declared(run: ReportedRun, name: str, shapes: Sequence[Row]) -> list[Block]:
    """Return an effect declared in the config: its coefficients and its shapes."""
    own = [row for row in run.tables["parameters"] if row["parameter"].startswith(f"{name}.")]
    rows = [
        (
            code(row["label"].removeprefix(f"{name}.")),
            beside(row["value"], row["upper95"] - row["lower95"]),
            interval(row["lower95"], row["upper95"]),
            row["unit"],
            TableCell("held" if row["estimated_on"] == "known" else "", "faint"),
        )
        for row in own
    ]
    places = ", ".join(dict.fromkeys(row["part"] for row in shapes))
    heading = TextBlock(f"{name} at {places}", kind="heading")
    return [heading, table(COEFFICIENTS, rows), *_shapes(shapes)]


def candidates(run: ReportedRun) -> ReportSection:
    """Return the section of the ranked candidates, and of those that cannot be distinguished."""
    rows = run.tables["findings"]
    blocks: list[Block] = [
        _rivals(effect)
        for effect in run.facts.get("effects") or []
        if other_laws(effect) or (effect.get("claimed", True) and not effect.get("alternatives"))
    ]
    if rows:
        blocks.insert(
            0,
            TextBlock(
                "Each step ranks all candidates for a missing effect by their correlation with the "
                'residual. "Explained" is the share of the residual\'s sum of squares that the '
                "candidate explains to first order. The criterion is that of the model refitted "
                "with the candidate, minus that of the model without it (lower is better). "
                "Candidates that were not refitted have no criterion."
            ),
        )
    for step in sorted({row["step"] for row in rows}):
        own = sorted((row for row in rows if row["step"] == step), key=_rank)
        blocks.append(_ranked(step, own))
    blocks += _compared(run)
    return ReportSection("candidates", "Candidates", tuple(blocks))


REMOVED = (
    '"Removed" is the share of the squared error above the noise that a set of effects removes on '
    "the training data."
)
LEFT_OUT = (
    '"Left out" is the error of cross-validation on the training data; "held out" is the error on '
    "held-out experiments as a multiple of the noise. Only sets that the search accepted have "
    "these two errors. The answer is the set with the smallest error of cross-validation; held-out "
    "experiments do not choose it, but may reject it."
)


def _compared(run: ReportedRun) -> list[Block]:
    """Return the structures that each step refitted, the best first."""
    names = (
        "structure", "#removed", "#criterion", "#left out", "#held out", "#probability",
        "#chosen", "move", "",
    )  # fmt: skip
    blocks: list[Block] = []
    rows = [row for row in run.tables["structures"] if row["effects"]]  # without the declared model
    if rows:
        blocks.append(TextBlock(REMOVED))
    if any(row["left_out"] == row["left_out"] for row in rows):
        blocks.append(TextBlock(LEFT_OUT))
    for step in sorted({row["step"] for row in rows}):
        own = [row for row in rows if row["step"] == step]
        lines = [
            (
                code(" + ".join(row["effects"])),
                _closed(row),
                digits(row["criterion"], 4),
                *(digits(row[e], 3) if row[e] == row[e] else "" for e in ("left_out", "held_out")),
                _share(row, "probability"),
                _share(row, "chosen"),
                row["move"],
                TableCell("accepted", "good") if row["accepted"] else TableCell(_end(row), "faint"),
            )
            for row in own
        ]  # fmt: skip
        caption = f"Step {step}: {len(own)} sets of effects refitted"
        blocks.append(table(names, lines, caption, folded=True))
    return blocks


def _end(row: Row) -> str:
    """Return why a set of effects was not accepted; "" if another set was better."""
    if row["stopped_by"]:
        return f"stopped by: {row['stopped_by']}"
    return "" if row["converged"] else "fell behind"


def _closed(row: Row) -> str:
    """Return the share of the gap that a set of effects closes; "" without a gap."""
    closed = row["closed"]
    return in_percent(closed, 1).replace("%", "\u2009%") if math.isfinite(closed) else ""


def _share(row: Row, name: str) -> str:
    """Return a probability of a set of effects; "" if it has none."""
    share = row[name]
    if share is None or share != share:
        return ""
    return percent(share).replace(" %", "\u2009%")


STAGES = tuple(reversed(CandidateStage))
"""Stages of candidates, the last one first."""


def _rank(row: Row) -> tuple[int, float, float]:
    stage = row["stage"]
    place = STAGES.index(stage) if stage in STAGES else len(STAGES)
    criterion = row["criterion"]
    return place, 0.0 if criterion is None or criterion != criterion else criterion, row["log_p"]


def _ranked(step: int, rows: list[Row]) -> TableBlock:
    names = ("site", "form", "of", "stage", "#explained", "#log₁₀ p", "#criterion", "")
    lines = [
        (
            code(row["site"]),
            row["form"],
            code(", ".join(row["variables"] or ())),
            TableCell(row["stage"], "good" if row["stage"] == CandidateStage.ACCEPTED else ""),
            in_percent(row["explained"], 1).replace("%", "\u2009%"),
            digits(row["log_p"] / np.log(10.0), 4),
            digits(row["criterion"], 4),
            TableCell(
                f"confounded with {each}" if (each := row["confounded_with"]) else "", "faint"
            ),
        )
        for row in rows
    ]
    return table(names, lines, f"Step {step}: {len(rows)} candidates", folded=True)


def _rivals(effect: Row) -> Block:
    others = other_laws(effect)
    if not others:
        return TextBlock(f"{effect['name']}: {NO_ALTERNATIVE}.")
    names = ("cannot be distinguished", "equation", "#criterion", "differ most at", "#by")
    chosen = f"{effect['words']} at {effect['site']} (chosen)"
    lines: list[TableLine] = [(chosen, code(effect["equation"]), "0", "", "")]
    for other in others:
        at, by = "", ""
        if other["experiment"] and other["time"] is not None and other["difference"] is not None:
            at = f"{other['output']} of {other['experiment']}, {digits(other['time'])} s"
            by = f"{digits(other['difference'], 2)} times the noise"
        criterion, said = other["criterion"], f"{other['words']} at {other['site']}"
        said += f" (with it, {moved})" if (moved := other.get("parameters")) else ""
        said += f"; {BETTER}" if other.get("better") else ""
        worse = "" if criterion is None else ("+" if criterion >= 0 else "") + digits(criterion, 3)
        lines.append((said, code(other["equation"]), worse, at, by))
    return table(
        names, lines, f"{effect['name']}: {len(lines)} effects that explain the data equally well"
    )
