"""The command check: what is wrong with a config, its data and its FMU."""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printing import number
from cluster_est.cli.terminal import build_core
from cluster_est.config.choices import build_resources
from cluster_est.errors import ModelError
from cluster_est.preflight.all_checks import SECONDS, run_checks
from cluster_est.preflight.data_checks import long_records, sigma_findings
from cluster_est.preflight.subject import CheckPage, CheckVerdict, bare_problem, passed
from cluster_est.preflight.unit_checks import unit_findings
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.results.fit_tables import constraints_at_start
from cluster_est.results.output_errors import Simulation
from cluster_est.run_folder.run_identity import RunKind
from cluster_est.running.resources import Resources
from cluster_est.studies.configured import read_study
from workers.fmu.description import ModelDescription


def print_page(answer: Answer, page: CheckPage) -> None:
    """Print a line for each check, with advice below it."""
    counts = Counter(each.verdict for each in page.findings)
    answer.add(
        checks=[vars(each) for each in page.findings],
        problems=counts[CheckVerdict.PROBLEM],
        check_notes=counts[CheckVerdict.NOTE],
        not_done=counts[CheckVerdict.NOT_DONE],
    )
    if not page.findings:
        return
    answer.say("")
    verdicts = max(len(each.verdict) for each in page.findings)
    names = max(len(each.check) for each in page.findings)
    for each in page.findings:
        answer.say(f"{each.verdict:{verdicts}}  {each.check:{names}}  {each.found}")
        if each.do:
            answer.say(f"{'':{verdicts}}  {'':{names}}  -> {each.do}")
    answer.say("")
    problems, notes = counts[CheckVerdict.PROBLEM], counts[CheckVerdict.NOTE]
    left = counts[CheckVerdict.NOT_DONE]
    said = _counted(problems, "problem") if problems else "no problem was found"
    if notes:
        said += f"; read the {_counted(notes, 'note')} too"
    if 0 < left < len(page.findings):
        are = "was" if left == 1 else "were"
        said = f"{left} of {len(page.findings)} checks {are} not done; result of the others: {said}"
    elif left:
        said = "nothing has been checked yet"
    answer.say(said)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def print_model(answer: Answer, problem: Problem, more: str) -> None:
    """Print the model, the faults of its description, and how it is simulated."""
    model = problem.model
    answer.say(
        f"{model.name}: {model.interface.replace('_', ' ')}, solver {model.solver.name}; {more}",
    )
    answer.add(
        model={
            "name": model.name,
            "interface": model.interface,
            "solver": model.solver.name,
        }
    )
    for warning in (*problem.describe().warnings, *problem.model_notes()):
        answer.say(warning)


MOST_LISTED = 40
"""Largest number of variables of a kind in the printed table; further ones are counted."""


def print_variables(answer: Answer, description: ModelDescription) -> None:
    """Print the inputs, outputs, states and parameters of an FMU with their units."""
    every = description.variables.values()
    own = [each for each in every if each.alias_of is None and not each.is_tool_setting]
    names = {
        "input": [each.name for each in own if each.causality == "input"],
        "output": list(description.outputs),
        "state": list(description.states),
        "parameter": [e.name for e in own if e.causality == "parameter" and e.settable],
    }
    found: list[dict[str, Any]] = [
        {"name": name, "is": kind, "unit": each.unit, "start": each.start, "text": each.description}
        for kind, named in names.items()
        for name in named
        for each in (description.variables[name],)
    ]
    answer.add(variables=found)
    shown = [row for kind in names for row in [r for r in found if r["is"] == kind][:MOST_LISTED]]
    cells = [
        (row["name"], row["is"], row["unit"], _start(row["start"]), row["text"]) for row in shown
    ]
    answer.table(["variable", "is", "unit", "start", "description"], cells, fitted=True)
    for kind, named in names.items():
        if len(named) > MOST_LISTED:
            answer.say(f"and {len(named) - MOST_LISTED} more {kind}s; --json lists all of them")


def _start(start: float | None) -> str:
    return "" if start is None else f"{start:g}"


def print_check(answer: Answer, problem: Problem, simulations: Sequence[Simulation]) -> None:
    """Print the unknowns, the experiments and one simulation of each."""
    train = make_space(problem, problem.indices("train"))
    answer.say(
        f"{train.size} unknowns; a forward Jacobian takes {len(train.colours)} points, each with "
        f"{len(train.experiments)} experiments",
    )
    experiments = [_simulated(problem, each) for each in simulations]
    answer.rows(
        experiments,
        ("experiment", "id"),
        ("role", "role"),
        ("seconds", lambda row: f"{row['start']:g} .. {row['stop']:g}"),
        ("samples", "samples"),
        ("ms", lambda row: number(row["seconds"] * 1e3)),
        ("simulated", lambda row: row["message"] or row["status"]),
    )
    answer.add(unknowns=train.size, experiments=experiments)
    if train.constraint_names:
        values = constraints_at_start(train, list(simulations))
        named = zip(train.constraint_names, train.equality, values, strict=True)
        constraints = [
            {"constraint": name, "equality": bool(equal), "value": float(value)}
            for name, equal, value in named
        ]
        answer.rows(
            constraints,
            ("constraint", "constraint"),
            ("must be", lambda row: "= 0" if row["equality"] else "<= 0"),
            ("at the start", lambda row: number(row["value"])),
        )
        answer.add(constraints=constraints)


def _simulated(problem: Problem, simulation: Simulation) -> dict[str, Any]:
    experiment, outcome = problem.experiments[simulation.experiment], simulation.outcome
    return {
        "id": experiment.id,
        "role": experiment.role,
        "start": experiment.start,
        "stop": experiment.stop,
        "samples": experiment.size,
        "seconds": outcome.seconds,
        "status": str(outcome.status),
        "message": outcome.message,
    }


def check(options: Namespace, answer: Answer) -> int:
    """Read everything, try the FMU out in processes of its own, print a page; change nothing."""
    path = options.config
    seconds = SECONDS if options.seconds is None else options.seconds
    if path.suffix.lower() == ".fmu":
        bare = bare_problem(path)
        print_model(answer, bare, "with its own start values")
        print_variables(answer, bare.describe())
        build_core(answer)
        page = run_checks(bare, Resources(), seconds, declared=False)
        print_page(answer, page)
        return _verdict(page)
    run = read_study(path, options.overrides, RunKind.FIT, allow_code=options.allow_code)
    config, problem = run.config, run.identity.problem
    resources = build_resources(config)
    for sentence in resources.notes():
        answer.complain(sentence)
    print_model(answer, problem, f"method {config.method.name}")
    build_core(answer)
    page = run_checks(problem, resources, seconds)
    declared = [
        *sigma_findings(config, problem.describe()),
        *unit_findings(config, problem.describe(), problem.tables),
        *(passed("long records", f"for a fit and other steps, {each}") for each in run.notes),
        *long_records(config, problem),
    ]
    page = replace(page, findings=(*page.findings, *declared))
    if page.simulations:
        print_check(answer, problem, page.simulations)
    print_page(answer, page)
    return _verdict(page)


def _verdict(page: CheckPage) -> int:
    if not page.loads:
        raise ModelError(page.findings[0].found)
    return ExitCode.DONE if page.good else ExitCode.NO_SOLUTION
