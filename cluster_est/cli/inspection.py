"""The commands on a run folder: show, report, watch, replay and export."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cluster_est.cli.display.closed_loop import print_any_run
from cluster_est.cli.display.run import number, print_iterations, print_table, say
from cluster_est.cli.exit_codes import ExitCode
from cluster_est.report.numbers import count, duration
from cluster_est.report.watch import RunView, SearchView
from cluster_est.run_folder.log_segment import logged_cost
from cluster_est.run_folder.progress_file import RunState
from cluster_est.run_folder.progress_text import left_of_step, pace_of, what_is_done
from cluster_est.run_folder.replay import LoggedSimulation, ReplayRequest, comparison, read_failures
from workers.messages import Outcome


def show(options: Namespace) -> int:
    """Print the tables of a run, what failed in it, or one search's iterations."""
    run_folder = options.run_folder
    if options.failures:
        print_failures(Console(), run_folder)
    elif options.iterations or options.search is not None:
        print_iterations(Console(), run_folder, options.search)
    else:
        print_any_run(Console(), run_folder)
    return ExitCode.DONE


def report(options: Namespace) -> int:
    """Write the report of a run or of a sweep."""
    from cluster_est import report as reports  # not everybody wants to wait for Jinja

    folder, out = options.run_folder, options.out
    is_sweep = reports.is_sweep(folder)
    path = (
        reports.write_sweep_report(folder, out) if is_sweep else reports.write_report(folder, out)
    )
    say(Console(), f"report: {path}")
    return ExitCode.DONE


def watch(options: Namespace) -> int:
    """Follow a run until it ends."""
    from cluster_est.report.watch import follow

    with WatchTable(Console()) as table:
        follow(options.run_folder, options.every, table.show, html=options.html)
    return ExitCode.DONE


def replay(options: Namespace) -> int:
    """Run one logged simulation again, in a process of its own that shows the FMU's messages."""
    from cluster_est.run_folder.replay import prepare, read_logged
    from cluster_est.run_folder.replay import replay as run_replay

    logged = read_logged(options.run_folder, options.number)
    question = prepare(options.run_folder, logged, options.config, allow_code=options.allow_code)
    print_question(Console(), logged, question)
    outcome = run_replay(question)
    print_answer(Console(), logged, outcome)
    return ExitCode.NO_SOLUTION if outcome.failed else ExitCode.DONE


def export(options: Namespace) -> int:
    """Write what a run has found, in the forms that are asked for."""
    from cluster_est.export.repaired_fmu.fmu import FmuOptions
    from cluster_est.export.write import ExportRequest
    from cluster_est.export.write import export as run_export  # SymPy takes long to import

    if options.fmu is not None and options.platforms:
        wait = "compiling for other platforms; the first time, zig compiles their libraries too, "
        say(Console(stderr=True), f"cluster-est: {wait}which takes a minute or more")
    of_fmu = FmuOptions(tuple(options.platforms), measure=not options.no_step)
    wanted = ExportRequest(
        options.fmu, options.ssv, options.csv, options.modelica, options.text, of_fmu
    )
    written = run_export(
        options.run_folder,
        options.config,
        options.experiment,
        wanted,
        allow_code=options.allow_code,
    )
    for printed in written.printed:
        say(Console(), printed)
    for note in written.notes:
        say(Console(stderr=True), f"cluster-est: {note}")
    for path in written.files:
        say(Console(stderr=True), f"{path}")
    return ExitCode.DONE


def print_question(console: Console, logged: LoggedSimulation, question: ReplayRequest) -> None:
    """Who asked for it, its values and effects, and what came of it then."""
    say(console, f"evaluation {logged.number}: experiment {logged.experiment}")
    say(
        console,
        f"  asked by search {logged.search}, point {logged.evaluation}, for: {logged.purpose}",
    )
    rows = [(name, repr(value)) for name, value in question.named_values]
    print_table(console, ["parameter", "value"], rows)
    for effect in question.task.effects:
        what = effect.form or effect.equation
        say(console, f"effect {effect.name} at {effect.site}: {what}")
    say(console, "")
    say(console, f"then: {_ending(logged.status, logged.message, logged, logged.cost)}")
    if not question.same:
        say(
            console,
            "note: the FMU, its solver, the data, their weights or the effects are not those of "
            "the run any more",
        )
    say(console, "what the FMU says, if anything:")


def print_answer(console: Console, logged: LoggedSimulation, outcome: Outcome) -> None:
    """Print the outcome, and whether it is the same as in the log."""
    cost = logged_cost(outcome, logged.want)
    say(console, f"now: {_ending(str(outcome.status), outcome.message, logged, cost)}")
    say(console, comparison(logged, outcome))


def _ending(status: str, message: str, logged: LoggedSimulation, cost: float) -> str:
    return f"{status}: {message}" if message else f"{status}, sum of {logged.summed} {number(cost)}"


def print_failures(console: Console, run_folder: Path) -> None:
    """Every simulation of a run that failed, with the ID that `replay` takes.

    Raises
    ------
    RunFolderError
        If there is no log.
    """
    failed = read_failures(run_folder)
    if not failed:
        say(console, f"run {run_folder}: no simulation failed")
        return
    print_table(
        console,
        ["ID", "search", "purpose", "experiment", "status", "message"],
        [(str(f.number), f.search, f.purpose, f.experiment, f.status, f.message) for f in failed],
    )
    say(console, f"to run one again: cluster-est replay {run_folder} ID")


MOST_SEARCHES, MOST_FAILURES = 12, 5
QUIET_SECONDS = 30.0
"""After these it is worth a sentence that nothing comes."""


class WatchTable:
    """Shows views in place on a terminal; elsewhere only the last one, as lines.

    Parameters
    ----------
    console
        Where to.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False)
        self._last: RunView | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._live.stop()
        elif self._last is not None:
            self._console.print(rendered(self._last))

    def show(self, view: RunView) -> None:
        """Renew the table."""
        self._last = view
        if self._console.is_terminal:
            self._live.update(rendered(view), refresh=True)


def rendered(view: RunView) -> Group:
    """The lines and tables of a view."""
    parts: list[Text | Table] = [Text(_head(view), style="bold"), Text(_numbers(view))]
    if view.state is not None and not view.ended:
        parts.insert(1, Text(_now(view.state)))
    if view.message:
        parts.append(Text(view.message))
    if not view.ended and view.quiet > QUIET_SECONDS:
        parts.append(
            Text(f"nothing has come for {duration(view.quiet)}; the run may have been killed")
        )
    if view.searches:
        parts.append(_searches(view.searches))
    if view.failures:
        parts.append(_failures(view))
    if view.problem:
        parts.append(Text(f"the report could not be written: {view.problem}"))
    return Group(*parts)


def _head(view: RunView) -> str:
    state = view.state
    elapsed = f", {duration(state.seconds)}" if state is not None else ""
    return f"{view.status}{elapsed}"


def _now(state: RunState) -> str:
    done = what_is_done(state.search, state.phase, state.ended, state.searches)
    left = left_of_step(state.phase, state.left, at_most=state.at_most)
    return " | ".join(part for part in (done, left, pace_of(state.pace)) if part)


def _numbers(view: RunView) -> str:
    state = view.state
    parts = [f"{count(view.simulations)} simulations ({count(view.failed)} failed)"]
    if state is not None:
        parts.insert(0, f"{count(state.evaluations)} evaluations")
    if not view.ended:
        if not math.isnan(view.rate):
            parts.append(f"{view.rate:.3g} simulations/s")
        if state is not None:
            parts.append(f"{state.busy}/{state.workers} workers busy")
    return " | ".join(parts)


def _searches(searches: tuple[SearchView, ...]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("search")
    for name in ("iteration", "evaluations", "best cost", "cost"):
        table.add_column(name, justify="right")
    table.add_column("")
    for each in searches[-MOST_SEARCHES:]:
        line = each.last
        table.add_row(
            Text(line.search),
            str(line.iteration),
            str(line.evaluations),
            _cost(each.best),
            _cost(line.cost),
            Text(line.ending),
        )
    if len(searches) > MOST_SEARCHES:
        table.caption = f"the last {MOST_SEARCHES} of {len(searches)}"
    return table


def _cost(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _failures(view: RunView) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("failed", justify="right")
    table.add_column("status")
    table.add_column("reason")
    for each in view.failures[:MOST_FAILURES]:
        table.add_row(str(each.count), Text(each.status), Text(each.message))
    if len(view.failures) > MOST_FAILURES:
        table.caption = f"and {len(view.failures) - MOST_FAILURES} other reasons"
    return table
