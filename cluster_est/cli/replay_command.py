"""The command replay, and the list of failures that `show` prints for it."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import Any

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printing import number
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


def replay(options: Namespace, answer: Answer) -> int:
    """Run one logged simulation again, in a process of its own that shows the FMU's messages."""
    logged = read_logged(options.run_folder, options.number)
    question = prepare(options.run_folder, logged, options.config, allow_code=options.allow_code)
    print_question(answer, logged, question)
    outcome = run_replay(question)
    print_answer(answer, logged, outcome)
    return ExitCode.NO_SOLUTION if outcome.failed else ExitCode.DONE


def print_question(answer: Answer, logged: LoggedSimulation, question: ReplayRequest) -> None:
    """Print the origin of a simulation, its values and effects, and its logged result."""
    answer.say(f"evaluation {logged.number}: experiment {logged.experiment}")
    answer.say(
        f"  requested by search {logged.search}, point {logged.evaluation}, for: {logged.purpose}",
    )
    rows = [(name, repr(value)) for name, value in question.named_values]
    answer.add(
        logged={
            "number": logged.number,
            "experiment": logged.experiment,
            "search": logged.search,
            "point": logged.evaluation,
            "purpose": logged.purpose,
            "effects": logged.effects,
        },
        values=dict(question.named_values),
        then=_outcome(logged.status, logged.message, logged.cost),
        same_inputs=question.same,
    )
    answer.table(["parameter", "value"], rows)
    for effect in question.task.effects:
        what = effect.form or effect.equation
        answer.say(f"effect {effect.name} at {effect.site}: {what}")
    answer.say("")
    answer.say(f"then: {_ending(logged.status, logged.message, logged, logged.cost)}")
    if not question.same:
        answer.say(
            "note: the FMU, its solver, the data, their weights or the effects are not the same as "
            "in the run",
        )
    answer.say("messages of the FMU, if any:")


def print_answer(answer: Answer, logged: LoggedSimulation, outcome: Outcome) -> None:
    """Print the outcome, and whether it is the same as in the log."""
    cost = logged_cost(outcome, logged.want)
    answer.add(now=_outcome(str(outcome.status), outcome.message, cost))
    answer.say(f"now: {_ending(str(outcome.status), outcome.message, logged, cost)}")
    answer.say(comparison(logged, outcome))


def _outcome(status: str, message: str, cost: float) -> dict[str, Any]:
    return {"status": status, "message": message, "cost": cost}


def _ending(status: str, message: str, logged: LoggedSimulation, cost: float) -> str:
    return f"{status}: {message}" if message else f"{status}, sum of {logged.summed} {number(cost)}"


def print_failures(answer: Answer, run_folder: Path) -> None:
    """Print every failed simulation of a run, with its ID for `replay`.

    Raises
    ------
    RunFolderError
        If there is no log.
    """
    failed = read_failures(run_folder)
    answer.add(run=run_folder, failed=[_failed(each) for each in failed])
    if not failed:
        answer.say(f"run {run_folder}: no simulation failed")
        return
    answer.table(
        ["ID", "search", "purpose", "experiment", "status", "message"],
        [(str(f.number), f.search, f.purpose, f.experiment, f.status, f.message) for f in failed],
    )
    answer.say(f"to repeat a simulation: cluster-est replay {run_folder} ID")


def _failed(each: LoggedSimulation) -> dict[str, Any]:
    named = ("number", "search", "evaluation", "purpose", "experiment", "status", "message")
    return {name: getattr(each, name) for name in named}
