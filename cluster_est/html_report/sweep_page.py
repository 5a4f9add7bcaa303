"""The report of a sweep: a comparison of its runs, the best first, with links to their reports."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np

from cluster_est.errors import RunFolderError
from cluster_est.html_report.charts import (
    Dots,
    Line,
    Mark,
    Rules,
    row_chart,
)
from cluster_est.html_report.error_sections import error_sizes, error_table
from cluster_est.html_report.first_screen import parameter_table
from cluster_est.html_report.headline import next_steps, summarise
from cluster_est.html_report.number_text import count, digits, duration
from cluster_est.html_report.page import REPORT, rendered, write_page, write_report
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    GridBlock,
    NextStep,
    ReportSection,
    TableCell,
    TableLine,
    Tone,
    code,
    table,
    with_unit,
)
from cluster_est.html_report.reported_run import ReportedRun, Row, read_results
from cluster_est.html_report.scales import Scale
from cluster_est.html_report.sweep_history import history, read_history
from cluster_est.problem.display import in_a_row
from cluster_est.run_folder.run_files import SWEEP_SUMMARY_FILE, RunWorth, read_run_table, run_worth

PARAMETER = "parameter "
"""Prefix of the names of the columns of shared estimates."""
MOST_DRAWN = 60
"""Largest number of runs in a picture, of which the best are chosen."""
LEAST_SPAN = 0.1
"""Share of the largest estimate that a scale spans if there are no intervals."""
COLUMNS_OF_EVERY_SWEEP = (
    "run", "config", "status", "message", "doubts", "cost_before", "cost", "rmse_train",
    "rmse_test", "iterations", "evaluations", "simulations", "failures", "seconds", "seed",
    "started", "verdict", "effects", "together",
)  # fmt: skip
"""Columns that do not depend on the sweep; the others are its axes and its parameters."""
Role = str


@dataclass(frozen=True)
class ListedRun:
    """A run of a sweep: its row of the summary, and the contents of its folder, if it exists.

    `link` leads from the page to the run's own report; "" without a report.
    """

    row: Row
    found: ReportedRun | None = field(default=None, repr=False)
    link: str = ""

    @property
    def name(self) -> str:
        return str(self.row["run"])

    @property
    def worth(self) -> RunWorth:
        return run_worth(self.row["status"], self.row["doubts"])

    def error(self, role: Role) -> float:
        """Return the error relative to the noise, or to sigma if the noise is unknown."""
        sizes = None if self.found is None else error_sizes(self.found)
        if sizes is not None and sizes.is_noise and sizes.rows:
            return sizes.of(sizes.of_role(role), "after")
        return self.value(f"rmse_{role}")

    @property
    def judged_on(self) -> tuple[tuple[str, str], ...]:
        """The names and hashes of the experiments that rank the run: held out, or all if none is.

        Only errors on the same data can be compared.
        """
        if self.found is None:
            return ((str(self.row["config"]), ""),)
        keys = self.found.facts.get("experiments") or {}
        rows = self.found.tables["errors"]
        chosen = [row for row in rows if row["role"] == "test"] or rows
        return tuple(
            sorted({(row["experiment"], keys.get(row["experiment"], "")) for row in chosen})
        )

    @property
    def model(self) -> str:
        """The hash of its FMU; the name of its config if that is not known."""
        facts = {} if self.found is None else self.found.facts
        return str((facts.get("fmu") or {}).get("sha256") or self.row["config"])

    @property
    def over_noise(self) -> bool:
        return self.found is not None and error_sizes(self.found).is_noise

    def value(self, column: str) -> float:
        """Return a number of the summary; NaN if missing."""
        found = self.row.get(column)
        return math.nan if found is None else float(found)

    def estimate(self, label: str) -> tuple[float, float, float, str]:
        """Return the estimate of a shared parameter, the ends of its interval, and its unit."""
        rows = () if self.found is None else self.found.tables["parameters"]
        for row in rows:
            if row["label"] == label:
                return row["value"], row["lower95"], row["upper95"], row["unit"]
        return self.value(f"{PARAMETER}{label}"), math.nan, math.nan, ""


def is_sweep(folder: Path) -> bool:
    """Return whether a folder is that of a sweep."""
    return (folder / SWEEP_SUMMARY_FILE).is_file()


def write_sweep_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a sweep atomically, after the missing reports of its runs.

    Parameters
    ----------
    folder
        Folder of the sweep, finished or not.
    out
        The file to write; report.html in the folder if None.

    Raises
    ------
    RunFolderError
        If its summary is damaged, or the file cannot be written.
    """
    path, folder = folder / REPORT if out is None else out, folder.absolute()
    runs = [_listed(folder, row, path) for row in read_run_table(folder / SWEEP_SUMMARY_FILE)]
    groups = _groups(runs)
    ranked = [run for group in groups for run in group]
    best = ranked[0] if len(groups) == 1 else None
    title, tone = _headline(runs, groups)
    words: list[Block] = []
    if best is not None and best.found is not None:
        rest = "see the report of the best run"
        words = [*parameter_table(best.found, rest), *error_table(best.found)]
    sections = (_estimates(ranked), _history(folder, runs, best), _runs(runs))
    page = rendered(
        "sweep.html",
        name=folder.resolve().name,
        title=title,
        tone=tone,
        sentences=_sentences(runs, groups),
        words=words,
        best="" if best is None else best.link,
        steps=_steps(groups),
        pictures=errors(ranked),
        sections=[section for section in sections if section.blocks],
    )
    write_page(path, page)
    return path


def read_sweep_runs(folder: Path) -> list[ListedRun]:
    """Return the runs of a sweep that have an error, the best first for each set of data."""
    rows = read_run_table(folder / SWEEP_SUMMARY_FILE)
    groups = _groups([ListedRun(row, _found(folder / str(row["run"]))) for row in rows])
    return [run for group in groups for run in group]


def _found(folder: Path) -> ReportedRun | None:
    try:
        return read_results(folder)
    except RunFolderError:  # not yet run, or damaged; its row is shown nevertheless
        return None


def _listed(folder: Path, row: Row, page: Path) -> ListedRun:
    """Return a run with the contents of its folder, and write its own report."""
    own = folder / str(row["run"])
    found = _found(own)
    if found is None:
        return ListedRun(row)
    report = own / REPORT
    try:
        if not report.is_file() or report.stat().st_mtime < (own / "run.json").stat().st_mtime:
            write_report(own)
        relative = Path(os.path.relpath(report, page.absolute().parent)).as_posix()
    except (RunFolderError, ValueError):  # a damaged table, or a folder on another drive
        return ListedRun(row, found)
    return ListedRun(row, found, quote(relative))


def _groups(runs: Sequence[ListedRun]) -> list[list[ListedRun]]:
    """Return runs with an error, those on the same data together, the best of them first.

    They are ranked by held-out error, then by training error.
    """
    groups: dict[object, list[ListedRun]] = {}
    for run in runs:
        if math.isfinite(run.error("train")):
            groups.setdefault(run.judged_on, []).append(run)
    rank = lambda run: (_or_last(run.error("test")), run.error("train"))  # noqa: E731
    return [sorted(group, key=rank) for group in groups.values()]


def _or_last(error: float) -> float:
    return error if math.isfinite(error) else math.inf


def _headline(runs: Sequence[ListedRun], groups: Sequence[Sequence[ListedRun]]) -> tuple[str, Tone]:
    """Return the best run and its quality; green if its own report is green.

    Runs on different data have no best run.
    """
    if len(groups) == 1:
        said, tone = _verdict(groups[0][0])
        return f"Best of {count(len(runs))} runs: {said}", tone
    done = sum(run.row["status"] == "done" for run in runs)
    said = f"{count(done)} of {count(len(runs))} runs reached a solution"
    if not groups:
        return said, "" if done else "bad"
    tones = {_verdict(group[0])[1] for group in groups}
    tone = next((tone for tone in TONES if tone in tones), "")
    return f"{said}, on {count(len(groups))} different sets of data", tone


TONES: tuple[Tone, ...] = ("bad", "", "good")
"""The tones of a result, the worst first."""


def _verdict(best: ListedRun) -> tuple[str, Tone]:
    """Return the name of a run with its result, and its quality."""
    if best.found is not None:
        summary = summarise(best.found)
        return f"{best.name}. {summary.verdict}", summary.tone
    held_out = best.error("test")
    also = "" if math.isnan(held_out) else f", held out {digits(held_out, 3)}"
    said = f"{best.name}: error {digits(best.error('train'), 3)} over sigma{also}"
    return said, best.worth.value


def _steps(groups: Sequence[Sequence[ListedRun]]) -> tuple[NextStep, ...]:
    """Return the next steps after the best run, or after several sets of data."""
    if len(groups) > 1:
        return (NextStep("Open the reports of the runs; the table of runs leads to them."),)
    best = groups[0][0].found if groups else None
    return () if best is None else next_steps(best)


def _sentences(runs: Sequence[ListedRun], groups: Sequence[Sequence[ListedRun]]) -> list[str]:
    states = Counter(str(run.row["status"]) for run in runs)
    done = states["done"]
    doubtful = sum(run.worth is RunWorth.DOUBTFUL for run in runs)
    said = f"{count(done)} of {count(len(runs))} runs reached a solution"
    if doubtful:
        of = "all" if doubtful == done else count(doubtful)
        said += f"; {of} of these {'is' if of == '1' else 'are'} doubtful"
    others = [f"{count(n)} {state}" for state, n in states.items() if state != "done"]
    found = [f"{said}.", *([f"Of the others: {', '.join(others)}."] if others else [])]
    return [*found, *_best_of_each(groups), *_agreements(groups)]


def _best_of_each(groups: Sequence[Sequence[ListedRun]]) -> list[str]:
    """Return the best run on each set of data, if there are several sets with several runs."""
    said = [
        f"The best of {count(len(group))} runs on the same data is {group[0].name}."
        for group in groups
        if len(group) > 1
    ]
    if len(groups) < 2:
        return []
    return [COMPARED if len(said) < len(groups) else "", *said[:MOST_SETS]]


COMPARED = "Runs on different data are not compared with each other."
MOST_SETS = 5
"""Number of sets of data in the sentences."""


def _agreements(groups: Sequence[Sequence[ListedRun]]) -> list[str]:
    """Return whether runs of one model on the same data agree."""
    alike: dict[object, list[ListedRun]] = {}
    for run in (run for group in groups for run in group):
        alike.setdefault((run.judged_on, run.model), []).append(run)
    several = len(alike) > 1
    found = [_agreement(own, _named(own) if several else "The runs") for own in alike.values()]
    return list(filter(None, found))[:MOST_SETS]


def _named(runs: Sequence[ListedRun]) -> str:
    """Return runs of one model on the same data, by their configs."""
    configs = list(dict.fromkeys(str(run.row["config"]) for run in runs))
    return f"The {count(len(runs))} runs with {in_a_row(configs)}"


def _agreement(ranked: Sequence[ListedRun], called: str) -> str:
    """Return whether the 95 % intervals of all runs have a common value; "" if none is known."""
    apart, known = [], 0
    for label in _labels(ranked):
        ends = np.array([run.estimate(label)[1:3] for run in ranked])
        ends = ends[np.isfinite(ends).all(axis=1)]
        if len(ends) > 1:
            known += 1
            if ends[:, 0].max() > ends[:, 1].min():
                apart.append(label)
    if not known:
        return ""
    if not apart:
        return f"{called} agree: the 95 % intervals of each estimate overlap."
    named = ", ".join(apart[:5]) + (", …" if len(apart) > 5 else "")
    return f"{called} disagree on {named}: the 95 % intervals do not overlap."


def _labels(runs: Sequence[ListedRun]) -> list[str]:
    """Return the names of the shared parameters."""
    names = runs[0].row if runs else ()
    return [name.removeprefix(PARAMETER) for name in names if name.startswith(PARAMETER)]


def errors(ranked: Sequence[ListedRun]) -> list[FigureBlock]:
    """Return training and held-out errors of the runs in one picture."""
    drawn = ranked[:MOST_DRAWN]
    if not drawn:
        return []
    place = np.arange(len(drawn), dtype=float)
    sizes = {role: np.array([run.error(role) for run in drawn]) for role in ("train", "test")}
    marks: list[Mark] = [
        Dots(name, ink, sizes[role], place)
        for role, name, ink in (("train", "training", "after"), ("test", "held out", "before"))
        if np.isfinite(sizes[role]).any()
    ]
    over_noise = all(run.over_noise for run in drawn)
    if over_noise:
        marks.insert(0, Rules("noise", "measured", x=(1.0,)))
    known = [*sizes.values(), np.ones(1)] if over_noise else [*sizes.values()]
    across = Scale.around(*known, may_be_log=True)
    if not across.log:  # from 0, so that small differences look small
        across = Scale.around(*known, np.zeros(1))
    shown = "" if len(drawn) == len(ranked) else f", {len(drawn)} of {count(len(ranked))}"
    first = "the best first" if len({run.judged_on for run in drawn}) == 1 else "by their data"
    title = f"Errors of the runs, {first}{shown}"
    below = "error over the noise" if over_noise else "error over sigma"
    return [_by_run("errors-of-runs", title, below, across, marks, drawn)]


def _by_run(
    name: str, title: str, below: str, across: Scale, marks: Sequence[Mark],
    drawn: Sequence[ListedRun], *, ticks: int = 8,
) -> FigureBlock:  # fmt: skip
    """Return a picture with a row for each run."""
    names = [*_short_names(drawn).values()]
    chart = row_chart(title, below, across, marks, names, legend=len(marks) > 1, ticks=ticks)
    return FigureBlock(name, title, chart)


def _short_names(runs: Sequence[ListedRun]) -> dict[str, str]:
    """Return the values of each run on the sweep's axes, by its name; its name if they repeat."""
    axes = _axes(runs)
    choices = [", ".join(str(run.row[axis]) for axis in axes if run.row[axis]) for run in runs]
    often = Counter(choices)
    return {
        run.name: own if own and often[own] == 1 else run.name
        for own, run in zip(choices, runs, strict=True)
    }


def _axes(runs: Sequence[ListedRun]) -> list[str]:
    """Return the names of the sweep's axes."""
    return [
        name
        for name in (runs[0].row if runs else ())
        if name not in COLUMNS_OF_EVERY_SWEEP and not name.startswith(PARAMETER)
    ]


def _estimates(ranked: Sequence[ListedRun]) -> ReportSection:
    """Return the shared estimates of the runs with intervals, in a picture for each parameter."""
    drawn = ranked[:MOST_DRAWN]
    place = np.arange(len(drawn), dtype=float)
    figures = []
    for number, label in enumerate(_labels(drawn)):
        found = [run.estimate(label) for run in drawn]
        value, low, high = np.array([each[:3] for each in found], float).T
        if not np.isfinite(value).any():
            continue
        known = bool((np.isfinite(low) & np.isfinite(high)).any())
        gap = np.full(len(place), np.nan)
        bars = Line(
            "95 % interval",
            "faint",
            np.column_stack([low, high, gap]).ravel(),
            np.column_stack([place, place, gap]).ravel(),
        )
        across = Scale.around(value, low, high, least=0.0 if known else LEAST_SPAN)
        title = f"Estimates of {label}"
        below = with_unit(label, next((unit for *_, unit in found if unit), ""))
        marks = [*([bars] if known else []), Dots(label, "after", value, place)]
        name = f"estimates-{number}"
        figures.append(_by_run(name, title, below, across, marks, drawn, ticks=2))
    blocks = (GridBlock(tuple(figures)),) if figures else ()
    return ReportSection("estimates", "Estimates", blocks)


def _history(folder: Path, runs: Sequence[ListedRun], best: ListedRun | None) -> ReportSection:
    """Return the changes since the previous execution of the sweep."""
    rows = () if best is None or best.found is None else best.found.tables["parameters"]
    units = {row["label"]: row["unit"] for row in rows}
    named = _short_names(runs)
    return history(read_history(folder), "" if best is None else best.name, units, named)


def _runs(runs: Sequence[ListedRun]) -> ReportSection:
    """Return the summary table for readers."""
    axes = _axes(runs)
    loops = [name for name in ("verdict", "effects", "together") if _has(runs, name)]
    ended = [run for run in runs if math.isfinite(run.error("train"))]
    over = "noise" if all(run.over_noise for run in ended) else "sigma"
    names = (
        "run", *axes, "", *loops, f"#training, over {over}", "#held out", "#cost", "#simulations",
        "#time",
    )  # fmt: skip
    lines: list[TableLine] = [
        (
            TableCell(run.name, code=True, link=run.link),
            *(str(run.row[axis]) for axis in axes),
            TableCell("; ".join(filter(None, (run.row["status"], run.row["doubts"]))),
                      run.worth.value),
            *(str(run.row[name] or "") for name in loops),
            digits(run.error("train"), 3),
            digits(run.error("test"), 3),
            digits(run.value("cost")),
            _written(run, "simulations"),
            _written(run, "seconds"),
        )
        for run in runs
    ]  # fmt: skip
    reasons = tuple(
        (code(run.name), run.row["status"], run.row["message"])
        for run in runs
        if run.row["status"] != "done" and run.row["message"]
    )
    blocks: list[Block] = [table(names, lines)] if lines else []
    if reasons:
        blocks.append(table(("run", "", "why"), reasons, "Reasons for failed runs"))
    return ReportSection("runs", "Runs", tuple(blocks))


def _has(runs: Sequence[ListedRun], column: str) -> bool:
    return any(run.row.get(column) for run in runs)


def _written(run: ListedRun, column: str) -> str:
    value = run.value(column)
    if math.isnan(value):
        return ""
    return duration(value) if column == "seconds" else count(value)
