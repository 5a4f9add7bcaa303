"""Course of a run: its searches, work and failures, and the origin of its data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cluster_est.html_report.activity import busy_shares, without_breaks
from cluster_est.html_report.charts import (
    Cells,
    Chart,
    Dots,
    Line,
    Plot,
    Rules,
    row_chart,
)
from cluster_est.html_report.headline import command
from cluster_est.html_report.number_text import count, digits, duration, percent, time_unit
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    GridBlock,
    ReportSection,
    SourceBlock,
    TableCell,
    TableLine,
    TextBlock,
    code,
    table,
    with_unit,
)
from cluster_est.html_report.reported_run import ReportedRun, Row
from cluster_est.html_report.scales import Scale
from cluster_est.running.progress_line import search_title

MOST_DRAWN_SEARCHES = 40
"""Largest number of searches drawn, of which the best are chosen."""
AFTERWARDS = ("derivatives", "profile", "bootstrap", "records")
"""First words of the names of searches that examine a solution."""
MOST_DRAWN_COSTS = 3000
SMALL_MULTIPLES = 12
LEAST_SPREAD = 0.01
"""Smallest range of a plot of several minima, as a share of the cost."""
FEW_POINTS, MOST_LEGEND_ENTRIES, SERIES = 60, 12, 8
MOST_SETS = 20
LEAST_CLOSED = -25.0
"""Lower end of the picture of effect sets, in per cent; worse sets are drawn at this end."""
STEPS_NOTE = (
    "The number before a set is the step of the search. At 100 %, only noise is left; below 0 %, "
    "the set fits worse than the declared model."
)
PROFILE_NOTE = (
    "Each curve shows the rise of the cost if one parameter is held at a value. Steep sides mean "
    "that the data determine this parameter. The dashed lines mark the ends of its interval."
)
PATH_NOTE = (
    "The cost of a good search falls steeply and then becomes flat; if the cost still falls at the "
    "end, the search has not converged."
)


def search(run: ReportedRun) -> ReportSection:
    """Return the section with all data about the search in the folder."""
    if run.is_sensitivity or run.is_design:  # these runs have no search
        return ReportSection("search", "How the search went", ())
    said = [TextBlock(" ".join(costs))] if (costs := _costs(run)) else []
    blocks = [*said, *_steps(run), *_convergence(run), *_starts(run), *_front(run)]
    return ReportSection("search", "How the search went", tuple(blocks))


def _costs(run: ReportedRun) -> list[str]:
    """Return how the search ended and how the cost changed."""
    message = "" if run.is_loop else run.facts.get("message") or ""
    ended = [f"The search ended: {message}."] if message and run.finished else []
    before, after = run.facts.get("cost_before"), run.facts.get("cost")
    if before is None or after is None:
        if run.finished:
            ended.append("The cost before and after is not known, because a simulation failed.")
        return ended
    what = "after the fit of the declared model" if run.is_loop else "at the start values"
    said = f"The cost was {digits(before)} {what} and is {digits(after)}"
    if after and before and abs(after / before - 1.0) > 5e-3:
        larger, smaller = max(after, before), min(after, before)
        said += (
            f": a factor of {digits(larger / smaller, 3)} {'lower' if after < before else 'higher'}"
        )
    return [*ended, f"{said}."]


def _steps(run: ReportedRun) -> list[Block]:
    """Return the share of the gap closed by each set of effects, step by step."""
    known = [row for row in run.tables["structures"] if row["effects"]]
    rows = [row for row in known if math.isfinite(row["closed"])]
    best = sorted(rows, key=lambda row: (not row["accepted"], -row["closed"]))[:MOST_SETS]
    best.sort(key=lambda row: (row["step"], -row["closed"]))
    closed = np.clip([100.0 * row["closed"] for row in best], LEAST_CLOSED, None)
    accepted = np.array([row["accepted"] for row in best], bool)
    place = np.arange(len(best), dtype=float)
    marks = [
        Dots(name, ink, closed[chosen], place[chosen])
        for chosen, name, ink in ((~accepted, "refitted", "faint"), (accepted, "accepted", "after"))
        if len(best) and chosen.any()
    ]
    if not marks:
        return []
    names = [f"{row['step']}: {' + '.join(row['effects'])}" for row in best]
    across = Scale.around(closed, np.array([0.0, 100.0]))
    shown = "" if len(best) == len(rows) else f", the best {len(best)} of {len(rows)}"
    title = f"Squared error above the noise that each set of effects removed{shown}"
    below = "removed share, on the training data (%)"
    return [FigureBlock("steps", title, row_chart(title, below, across, marks, names), STEPS_NOTE)]


def _convergence(run: ReportedRun) -> list[Block]:
    searches: dict[str, list[Row]] = {}
    for row in run.tables["searches"]:
        if row["search"].startswith(AFTERWARDS):
            continue
        if row["cost"] is not None and math.isfinite(row["cost"]):
            searches.setdefault(row["search"], []).append(row)
    moving = {name: rows for name, rows in searches.items() if len(rows) > 1}
    searches = moving or searches  # searches with a single point show no convergence
    if not searches:
        return []
    if any(_begins_again(rows) for rows in searches.values()):
        return _all_searches(run)
    best = {name: min(row["cost"] for row in rows) for name, rows in searches.items()}
    names = sorted(searches, key=lambda name: (best[name], name))[:MOST_DRAWN_SEARCHES]
    lead = next((n for n in ("train", "final", "base", *names) if n in searches), names[0])
    order = [name for name in searches if name in names and name != lead] + [lead]
    marks: list[Line | Dots] = []
    for number, name in enumerate(order):
        x = np.array([row["evaluations"] for row in searches[name]], float)
        y = np.array([row["cost"] for row in searches[name]], float)
        ink = "after" if name == lead else f"series-{number % SERIES}"
        marks.append(Line(name, ink, x, y, steps=True))
        if len(x) < FEW_POINTS:
            marks.append(Dots("", ink, x, y))
    shown = "" if len(names) == len(searches) else f", the best {len(names)} of {len(searches)}"
    title = f"Cost over evaluations{shown}"
    plot = _plot(title, "cost", marks)
    chart = Chart(
        (plot,), "evaluations of the search", legend=1 < len(order) <= MOST_LEGEND_ENTRIES
    )
    return [FigureBlock("convergence", title, chart, PATH_NOTE)]


def _begins_again(rows: Sequence[Row]) -> bool:
    """Return whether several searches have the same name, as in a closed loop."""
    return any(later["evaluations"] < row["evaluations"] for row, later in pairwise(rows))


def _all_searches(run: ReportedRun) -> list[Block]:
    """Return the costs of all searches as points, in their order."""
    rows = [
        (number, row)
        for number, row in enumerate(run.tables["progress"])
        if math.isfinite(row["cost"])
    ]
    rows = rows[:: max(1, len(rows) // MOST_DRAWN_COSTS)]
    if not rows:
        return [
            TextBlock(
                "The folder of this run does not distinguish its searches, so no curve is drawn.",
                "faint",
            )
        ]
    marks = []
    titles = {row["search"]: search_title(row["search"]) for _, row in rows}
    for place, name in enumerate(dict.fromkeys(titles.values())):
        own = [(number, row["cost"]) for number, row in rows if titles[row["search"]] == name]
        x, y = (np.array(values, float) for values in zip(*own, strict=True))
        marks.append(Dots(name, f"series-{place % SERIES}", x, y))
    title = "Costs of all searches"
    chart = Chart(
        (_plot(title, "cost", marks),),
        "iterations, counted over all searches",
        legend=len(marks) <= MOST_LEGEND_ENTRIES,
    )
    note = (
        "The search for missing effects runs many parameter searches, coloured here by their "
        "purpose. Each dot is one iteration of a parameter search. Some of these searches use only "
        "a part of the experiments, and therefore have lower costs."
    )
    return [FigureBlock("convergence", title, chart, note)]


def _plot(title: str, label: str, marks: Sequence[Line | Dots]) -> Plot:
    """Return a plot of lines and dots, with a logarithmic scale if the values span much."""
    x = Scale.around(*(mark.x for mark in marks))
    y = Scale.around(*(mark.y for mark in marks), may_be_log=True)
    return Plot(title, label, x, y, marks, 260)


def _starts(run: ReportedRun) -> list[Block]:
    rows = run.tables["starts"]
    if not rows:
        return []
    ended = sorted((r for r in rows if r["cost"] is not None and math.isfinite(r["cost"])),
                   key=lambda r: (r["cost"], r["start"]))  # fmt: skip
    marks = []
    for sign, name, ink in (
        (0, "best minimum", "after"),
        (1, "other minima", "before"),
        (-1, "no minimum", "faint"),
    ):
        own = [(i + 1.0, r["cost"]) for i, r in enumerate(ended) if np.sign(r["minimum"]) == sign]
        if own:
            x, y = (np.array(values, float) for values in zip(*own, strict=True))
            marks.append(Dots(name, ink, x, y))
    blocks: list[Block] = []
    if marks:
        title = f"Waterfall of {len(rows)} starts"
        costs = np.array([row["cost"] for row in ended], float)
        across = Scale.around(np.array([1.0, len(ended)]))
        upright = Scale.around(costs, may_be_log=True, least=LEAST_SPREAD)
        plot = Plot(title, "cost", across, upright, marks, 200)
        chart = Chart((plot,), "starts, the best first")
        note = "A flat step on the left means that many starts reached the same minimum."
        blocks.append(FigureBlock("waterfall", title, chart, note))
    return [*blocks, *_minima(run, rows)]


def _minima(run: ReportedRun, starts: Sequence[Row]) -> list[Block]:
    points = {row["point"]: row["cost"] for row in run.tables["minima"]}
    counts = Counter(row["minimum"] for row in starts)
    labels = list(dict.fromkeys(row["label"] for row in run.tables["minima"]))[:6]
    values = {(row["point"], row["label"]): row["value"] for row in run.tables["minima"]}
    lines: list[TableLine] = [
        (str(p), digits(cost, 6), str(counts[p]), *(digits(values.get((p, n))) for n in labels))
        for p, cost in points.items()
    ]
    if counts[-1]:
        lines.append((TableCell("none", "bad"), "", str(counts[-1]), *("" for _ in labels)))
    names = ("minimum", "#cost", "#starts", *(f"#{label}" for label in labels))
    return [table(names, lines, "Minima that were reached")] if lines else []


def profiles(run: ReportedRun) -> list[Block]:
    """Return the increase of the cost with each parameter held at other values."""
    rows = [row for row in run.tables["profiles"] if row["unknown"] == row["label"]]
    labels = list(dict.fromkeys(row["label"] for row in rows))
    ends = {r["label"]: r for r in run.tables["intervals"] if r["source"] == "profile"}
    units = {row["label"]: row["unit"] for row in run.tables["parameters"]}
    figures: list[FigureBlock] = []
    for number, label in enumerate(labels[:SMALL_MULTIPLES]):
        own = sorted((r for r in rows if r["label"] == label), key=lambda r: r["value"])
        x = np.array([r["value"] for r in own], float)
        y = np.array([r["cost"] for r in own], float)
        y -= np.nanmin(y)
        found = ends.get(label, {"lower": None, "upper": None})
        known = [e for e in (found["lower"], found["upper"]) if e is not None and math.isfinite(e)]
        marks = [
            Rules("ends of the interval", "faint", known),
            Line("profile", "after", x, y),
            Dots("", "after", x, y),
        ]
        title = f"Profile of {label}"
        plot = Plot(title, "rise of the cost", Scale.around(x), Scale.around(y), marks, 130)
        below = with_unit(label, units.get(label, ""))
        chart = Chart((plot,), below, legend=False, across=3)
        figures.append(FigureBlock(f"profile-{number}", title, chart))
    if not figures:
        return []
    shown = (
        f" Of {len(labels)} profiles, {len(figures)} are drawn." if labels[len(figures) :] else ""
    )
    return [
        TextBlock("Profiles", kind="heading"),
        GridBlock(tuple(figures)),
        TextBlock(f"{PROFILE_NOTE}{shown}", "faint"),
    ]


def _front(run: ReportedRun) -> list[Block]:
    points = {row["point"]: row["objectives"] for row in run.tables["front"]}
    if not points or min(map(len, points.values())) < 2:
        return []
    first, second = ([values[i] for values in points.values()] for i in (0, 1))
    marks = [Dots("front", "after", np.array(first, float), np.array(second, float))]
    title = f"Front of {len(points)} points"
    plot = _plot(title, "second objective", marks)
    return [FigureBlock("front", title, Chart((plot,), "first objective", legend=False))]


ACTIVITY_BINS, MOST_WORKERS = 160, 64


def workers(run: ReportedRun) -> ReportSection:
    """Return the section with a time line, a table of workers, and failures by reason."""
    blocks = [*_work(run), *_failures(run), *_time_line(run), *_table(run)]
    return ReportSection("workers", "Workers and failures", tuple(blocks))


def _work(run: ReportedRun) -> list[Block]:
    """Return the number of simulations, and the duration of the run."""
    simulations, failures = run.simulated
    if not simulations:
        return []
    failed = f"{count(failures)} failed" if failures else "none failed"
    if failures and failures == run.facts.get("failures_in_search"):
        failed += ", all of them in the search for effects"
    said = f"{count(simulations)} simulations, {failed}"
    if run.facts.get("seconds") is not None:
        workers = len(run.tables["workers"]) or 1
        said += (
            f"; {duration(run.facts['seconds'])} with {workers} worker{'s' if workers > 1 else ''}"
        )
    return [TextBlock(f"{said}.")]


def _failures(run: ReportedRun) -> list[Block]:
    found = run.activity.failures
    if not found:
        return []
    names = ("#times", "status", "reason", "experiments", "#first ID")
    rows = tuple(
        (
            count(each.count),
            each.status,
            each.message or "no message",
            ", ".join(each.experiments[:4]) + (" …" if len(each.experiments) > 4 else ""),
            str(each.first),
        )
        for each in found
    )
    again = command("replay", run.path, str(found[0].first))
    hint = TextBlock(f"To repeat the first of these simulations: {again}", "faint")
    return [table(names, rows, "Failed simulations", folded=len(rows) > 20), hint]


def _time_line(run: ReportedRun) -> list[Block]:
    activity = run.activity
    if not len(activity.ended):
        return []
    activity, idle = without_breaks(activity)
    edges, shares = busy_shares(activity, ACTIVITY_BINS)
    order = sorted(range(len(activity.workers)), key=lambda i: activity.workers[i])[:MOST_WORKERS]
    names = [activity.workers[i] for i in order]
    shown = "" if len(order) == len(activity.workers) else f", {len(order)} of them"
    cut = f"; breaks of {duration(idle)} are cut out" if idle else ""
    title = f"When the workers were busy{shown}{cut}"
    unit = time_unit(float(edges[-1]))
    seconds = edges / unit.seconds
    below = f"{unit.name} since the first simulation began; darker means busier"
    across = Scale.around(seconds, margin=0.0)
    marks = [Cells("busy", "after", seconds, shares[order])]
    height = max(22, min(44, 400 // len(order)))
    chart = row_chart(title, below, across, marks, names, height=height, least=0, legend=False)
    return [FigureBlock("time-line", title, chart)]


def _table(run: ReportedRun) -> list[Block]:
    lines = [
        (
            code(row["worker"]),
            count(row["simulations"]),
            count(row["failures"]),
            duration(row["busy_seconds"]),
            percent(row["busy_seconds"] / row["seconds"] if row["seconds"] else None),
        )
        for row in run.tables["workers"]
    ]
    names = ("worker", "#simulations", "#failed", "#busy", "#of the time")
    return [table(names, lines, "Workers", folded=len(lines) > 12)] if lines else []


def provenance(run: ReportedRun) -> ReportSection:
    """Return the section with model, hashes, seed, versions, data and the resolved config."""
    facts = run.facts
    fmu = facts.get("fmu") or {}
    known = [
        ("FMU", fmu.get("name")),
        ("its SHA-256", fmu.get("sha256")),
        ("interface", str(fmu.get("interface") or "").replace("_", " ")),
        ("solver", fmu.get("solver")),
        ("config hash", facts.get("config_hash")),
        ("seed", facts.get("seed")),
        ("started", facts.get("started")),
        ("format", facts.get("format")),
    ]
    rows = [(k, code(str(v))) for k, v in known if v not in (None, "")]
    blocks: list[Block] = [table(("", ""), rows)]
    versions, experiments = facts.get("versions") or {}, facts.get("experiments") or {}
    for names, pairs, caption in (
        (("software", "version"), sorted(versions.items()), "Versions"),
        (
            ("experiment", "hash"),
            experiments.items(),
            f"Hashes of the {len(experiments)} experiments",
        ),
    ):
        if lines := [(str(k), code(str(v))) for k, v in pairs]:
            blocks.append(table(names, lines, caption, folded=True))
    if run.config:
        blocks.append(SourceBlock("The config, with every default", run.config))
    return ReportSection("provenance", "Origin of this result", tuple(blocks))
