"""The command replay, and the list of failures that `show` prints for it."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from rich.console import Console

from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printing import number, print_table, say
from cluster_est.run_folder.log_segment import logged_cost
from cluster_est.run_folder.logged_simulation import (
    LoggedSimulation,
    ReplayRequest,
    comparison,
    prepare,
    read_failures,
    read_logged,
)
from cluster_est.run_folder.logged_simulation import replay as run_replay
from workers.messages import Outcome


def replay(options: Namespace) -> int:
    """Run one logged simulation again, in a process of its own that shows the FMU's messages."""
    logged = read_logged(options.run_folder, options.number)
    question = prepare(options.run_folder, logged, options.config, allow_code=options.allow_code)
    print_question(Console(), logged, question)
    outcome = run_replay(question)
    print_answer(Console(), logged, outcome)
    return ExitCode.NO_SOLUTION if outcome.failed else ExitCode.DONE


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
