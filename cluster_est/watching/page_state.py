"""Data for the page of a run, or of a folder of runs: plain dictionaries for JSON."""

from __future__ import annotations

import calendar
import hashlib
import json
import math
import time
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.errors import RunFolderError
from cluster_est.html_report.activity import LogActivity, busy_shares, without_breaks
from cluster_est.html_report.curve_section import extremes
from cluster_est.run_folder.run_files import (
    RunStatus,
    left_alone,
    read_config_text,
    read_facts,
    read_run_table,
)
from cluster_est.run_folder.run_progress import PROGRESS, ProgressTail
from cluster_est.running.progress_line import (
    left_of_step,
    pace_of,
    search_title,
    what_is_done,
)
from cluster_est.running.resources import BestPoint, RunSnapshot
from cluster_est.watching.best_curves import ExperimentCurves
from cluster_est.watching.follower import RunView
from cluster_est.watching.traces import SearchTraces, is_of_fit

COST_COLUMNS, SMALL_COLUMNS = 300, 40
"""Numbers of columns of a chart of costs, and of a small line in a table."""
MOST_COST_LINES, MOST_PAGE_SEARCHES, MOST_PAGE_FAILURES = 40, 12, 8
MOST_PAGE_PARAMETERS = 200
MOST_PAGE_WORKERS, BUSY_BINS = 16, 60
MOST_OVERVIEW_PARAMETERS = 6
BOUNDS = ("lower", "upper")
PARAMETER_COLUMNS = (
    "label", "value", "unit", "description", "start", *BOUNDS, "std_error", "at_bound"
)  # fmt: skip
"""Columns of a run's parameters that its page shows."""


def run_state(name: str, view: RunView, activity: LogActivity) -> dict[str, Any]:
    """Return all data of a run's page except its curves."""
    state, facts, traces = view.state, view.facts, view.traces
    going_on = not view.ended
    return _plain({
        "name": name,
        "status": view.status,
        "goes_on": going_on,
        "verdict": facts.get("verdict"),
        "message": view.message,
        "summary": facts.get("summary"),
        "effects": [
            f"{each['words']} at {each['site']}" for each in facts.get("effects") or ()
        ],
        **_doing(state if going_on else None),
        "seconds": _known("seconds", facts, state),
        "quiet": view.quiet if going_on else 0.0,
        "evaluations": _known("evaluations", facts, state),
        "simulations": view.simulations,
        "failed": view.failed,
        "rate": view.rate if going_on else None,
        "workers": None if state is None else state.workers,
        "busy": None if state is None or view.ended else state.busy,
        "waiting": None if state is None or view.ended else state.waiting,
        "cost": best_cost(facts, traces.shown),
        "cost_of": traces.shown_model if facts.get("cost") is None else "",
        "cost_before": facts.get("cost_before"),
        "costs": _costs(traces),
        "searches": [
            {
                "title": search_title(each.last.search),
                "search": each.last.search,
                "iteration": each.last.iteration,
                "evaluations": each.last.evaluations,
                "best": each.best,
                "ending": each.last.ending,
            }
            for each in view.searches[-MOST_PAGE_SEARCHES:]
        ],
        "all_searches": len(view.searches),
        "failures": [
            {"count": f.count, "status": f.status, "message": f.message, "first": f.first}
            for f in view.failures[:MOST_PAGE_FAILURES]
        ],
        "all_failures": len(view.failures),
        "busy_shares": _busy(activity),
    })  # fmt: skip


def best_cost(facts: Mapping[str, Any], best: BestPoint | None) -> float | None:
    """Return the cost of a run's result, or of the best point so far."""
    known = facts.get("cost")
    if known is not None:
        return float(known)
    return None if best is None else best.cost


def _known(name: str, facts: Mapping[str, Any], state: RunSnapshot | None) -> Any:
    """Return a number of a run: the final one, otherwise the last reported one."""
    known = None if facts["status"] == RunStatus.RUNNING else facts.get(name)
    return getattr(state, name, None) if known is None else known


def _doing(state: RunSnapshot | None) -> dict[str, Any]:
    """Return the current activity in words, and its completed share if known."""
    if state is None:
        return {"doing": "", "left": "", "pace": "", "done": None, "of": None}
    return {
        "doing": what_is_done(state.search, state.phase, state.ended, state.searches),
        "left": left_of_step(state.phase, state.left, at_most=state.at_most),
        "pace": pace_of(state.pace),
        "done": state.ended,
        "of": state.searches,
    }


def _costs(traces: SearchTraces) -> dict[str, Any]:
    """Return lines of cost over the evaluations of each search, or dots if names are shared."""
    known = [each for each in traces.costs if is_of_fit(each[0])]
    if not known:
        return _all_costs(traces.costs)
    lines: dict[str, list[tuple[int, float]]] = {}
    for search, evaluations, cost in known:
        lines.setdefault(search, []).append((evaluations, cost))
    lowest = {name: min(cost for _, cost in line) for name, line in lines.items()}
    chosen = sorted(lines, key=lambda name: (lowest[name], name))[:MOST_COST_LINES]
    return {
        "across": "evaluations of the search",
        "lines": [{"name": name, "points": _thin(lines[name], COST_COLUMNS)} for name in chosen],
        "dots": [],
        "left_out": len(lines) - len(chosen),
    }


def _all_costs(costs: Sequence[tuple[str, int, float]]) -> dict[str, Any]:
    kinds: dict[str, list[tuple[int, float]]] = {}
    for number, (search, _, cost) in enumerate(costs):
        kinds.setdefault(search_title(search), []).append((number, cost))
    dots = [{"name": name, "points": _thin(own, COST_COLUMNS)} for name, own in kinds.items()]
    across = "iterations, counted over all searches"
    return {"across": across, "lines": [], "dots": dots, "left_out": 0}


def _thin(points: Sequence[tuple[float, float]], columns: int) -> list[tuple[float, float]]:
    x, y = (np.array(each, np.float64) for each in zip(*points, strict=True))
    return [points[i] for i in extremes(x, y, columns).tolist()]


def parameter_rows(run_folder: Path, view: RunView) -> list[dict[str, Any]]:
    """Return the parameters of the result, or of the best point of a fit so far."""
    table = run_folder / "parameters.parquet"
    if table.is_file() and (view.ended or view.facts.get("verdict") is not None):
        rows = [
            {name: row.get(name) for name in PARAMETER_COLUMNS} for row in read_run_table(table)
        ]
    elif view.traces.shown is not None:
        declared = _declared(run_folder)
        values = view.traces.shown.values.items()
        rows = [
            {"label": label, "value": value, **declared.get(label.partition("[")[0], {})}
            for label, value in values
        ]
    else:
        return []
    traced = view.traces.values
    lines = {label: _thin([*enumerate(went)], SMALL_COLUMNS) for label, went in traced.items()}
    return [
        _plain(
            {
                **_explained(view.facts, "parameters", str(row["label"]).partition("[")[0]),
                **row,
                "line": lines.get(str(row["label"]), []),
            }
        )
        for row in rows[:MOST_PAGE_PARAMETERS]
    ]


def _explained(facts: Mapping[str, Any], kind: str, name: str) -> dict[str, str]:
    """Return unit and description of a parameter or an output, as the run has written them."""
    known = ((facts.get("variables") or {}).get(kind) or {}).get(name) or {}
    return {key: str(known.get(key, "")) for key in ("unit", "description")}


def _declared(run_folder: Path) -> dict[str, dict[str, float]]:
    """Return start and bounds of each parameter that are numbers in the config."""
    sections = tomllib.loads(read_config_text(run_folder)).get("parameters", {})
    found: dict[str, dict[str, float]] = {}
    for name, section in sections.items():
        start, bounds = section.get("start"), section.get("bounds", [])
        own = {} if not isinstance(start, float) else {"start": start}
        if len(bounds) == len(BOUNDS):
            own |= dict(zip(BOUNDS, bounds, strict=True))
        found[name] = own
    return found


def _busy(activity: LogActivity) -> list[dict[str, Any]]:
    """Return the share of each time interval of the run in which each worker was busy."""
    if not len(activity.ended) or not np.isfinite(activity.ended).all():
        return []
    _, shares = busy_shares(without_breaks(activity)[0], BUSY_BINS)
    pairs = sorted(zip(activity.workers, shares, strict=True), key=lambda pair: pair[0])
    return [
        {"worker": name, "shares": np.round(own, 2).tolist()}
        for name, own in pairs[:MOST_PAGE_WORKERS]
    ]


def curves_state(curves: ExperimentCurves, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return curves for the page; `facts` of the run have units and descriptions."""
    return {
        "experiments": list(curves.experiments),
        "experiment": curves.experiment,
        "said": curves.said,
        "outputs": [
            {
                "name": each.name,
                **_explained(facts, "outputs", each.name),
                **{
                    part: [_number(v) for v in getattr(each, part).tolist()]
                    for part in ("time", "measured", "fine", "after", "before")
                },
            }
            for each in curves.outputs
        ],
    }


class RunRow:
    """One run of a folder of runs, read from its progress file and not from its log."""

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.name = path, name
        self._begin("")

    def _begin(self, started: str) -> None:
        self._started = started
        self._progress = ProgressTail(self.path / PROGRESS)
        self._traces = SearchTraces()

    def look(self) -> dict[str, Any]:
        """Return the current contents of its row."""
        try:
            facts = read_facts(self.path)
        except (RunFolderError, OSError) as error:
            return {"name": self.name, "status": "unreadable", "message": str(error)}
        if str(facts.get("started")) != self._started:
            self._begin(str(facts.get("started")))
        for line in self._progress.new():
            self._traces.note(line)
        return self._row(facts)

    def _row(self, facts: Mapping[str, Any]) -> dict[str, Any]:
        state, traces = self._progress.state, self._traces
        goes_on = facts["status"] == RunStatus.RUNNING
        best = traces.best
        # only the searches of a fit are of one model: other costs have no best so far
        points = list(enumerate(traces.lowest))
        return _plain({
            "name": self.name,
            "status": facts["status"],
            "goes_on": goes_on,
            "verdict": facts.get("verdict"),
            "message": facts.get("message") or left_alone(self.path, str(facts["status"])),
            "cost": best_cost(facts, traces.best),
            "data": _data_key(facts),
            "age": _age(facts.get("started")),
            "seconds": _known("seconds", facts, state),
            "simulations": _known("simulations", facts, state),
            "failed": _known("failures", facts, state),
            **_doing(state if goes_on else None),
            "line": _thin(points, COST_COLUMNS) if points else [],
            "values": {} if best is None else _first(best.values),
        })  # fmt: skip


def _data_key(facts: Mapping[str, Any]) -> str:
    """Return a key that runs share if they have the same FMU and the same experiments."""
    of = json.dumps([(facts.get("fmu") or {}).get("sha256"), facts.get("experiments")])
    return hashlib.sha256(of.encode()).hexdigest()[:16]


def _first(values: Mapping[str, float]) -> dict[str, float]:
    return dict(list(values.items())[:MOST_OVERVIEW_PARAMETERS])


def _age(started: object) -> float | None:
    """Return the seconds since a time in the format of run.json."""
    try:
        begun = calendar.timegm(time.strptime(str(started), "%Y-%m-%dT%H:%M:%SZ"))
    except ValueError:
        return None
    return max(0.0, time.time() - begun)


def _plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row for JSON, which has neither NaN nor infinity."""
    return {key: _said(value) for key, value in row.items()}


def _said(value: Any) -> Any:
    if isinstance(value, Mapping):
        return _plain(value)
    if isinstance(value, list | tuple):
        return [_said(each) for each in value]
    return _number(value) if isinstance(value, float) else value


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
