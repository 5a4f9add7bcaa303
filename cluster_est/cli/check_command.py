"""The command check: what is wrong with a config, its data and its FMU."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console

from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printing import number, print_table, say
from cluster_est.cli.terminal import build_core, complain
from cluster_est.config.choices import build_resources
from cluster_est.errors import ModelError
from cluster_est.preflight.all_checks import SECONDS, run_checks
from cluster_est.preflight.data_checks import long_records, sigma_findings
from cluster_est.preflight.subject import CheckPage, bare_problem, passed
from cluster_est.preflight.unit_checks import unit_findings
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.results.fit_tables import constraints_at_start
from cluster_est.results.output_errors import Simulation
from cluster_est.run_folder.run_identity import RunKind
from cluster_est.running.resources import Resources
from cluster_est.studies.configured import read_study


def print_page(console: Console, page: CheckPage) -> None:
    """A line for each check, and below it what can be done."""
    if not page.findings:
        return
    say(console, "")
    verdicts = max(len(each.verdict) for each in page.findings)
    names = max(len(each.check) for each in page.findings)
    for each in page.findings:
        say(console, f"{each.verdict:{verdicts}}  {each.check:{names}}  {each.found}")
        if each.do:
            say(console, f"{'':{verdicts}}  {'':{names}}  -> {each.do}")
    say(console, "")
    problems = sum(each.verdict == "problem" for each in page.findings)
    left = sum(each.verdict == "not done" for each in page.findings)
    notes = sum(each.verdict == "note" for each in page.findings)
    said = _counted(problems, "problem") if problems else "no problem was found"
    if notes:
        say_what = "says" if notes == 1 else "say"
        said += f"; {_counted(notes, 'note')} {say_what} what may be wrong"
    if 0 < left < len(page.findings):
        are = "was" if left == 1 else "were"
        said = f"{left} of {len(page.findings)} checks {are} not done; in the others {said}"
    elif left:
        said = "nothing was checked yet"
    say(console, said)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def print_model(console: Console, problem: Problem, more: str) -> None:
    """Print the model, the faults of its description, and how it is simulated."""
    model = problem.model
    say(
        console,
        f"{model.name}: {model.interface.replace('_', ' ')}, solver {model.solver.name}; {more}",
    )
    for warning in (*problem.describe().warnings, *problem.model_notes()):
        say(console, warning)


def print_check(console: Console, problem: Problem, simulations: Sequence[Simulation]) -> None:
    """Unknowns, experiments and one simulation of each."""
    train = make_space(problem, problem.indices("train"))
    say(
        console,
        f"{train.size} unknowns; a forward Jacobian costs {len(train.colours)} points x "
        f"{len(train.experiments)} experiments",
    )
    rows = []
    for simulation in simulations:
        experiment, outcome = problem.experiments[simulation.experiment], simulation.outcome
        rows.append(
            (
                experiment.id,
                experiment.role,
                f"{experiment.start:g} .. {experiment.stop:g}",
                str(experiment.size),
                number(outcome.seconds * 1e3),
                outcome.message or str(outcome.status),
            )
        )
    print_table(console, ["experiment", "role", "seconds", "samples", "ms", "simulated"], rows)
    if train.constraint_names:
        kinds = ["= 0" if equal else "<= 0" for equal in train.equality]
        values = [number(value) for value in constraints_at_start(train, list(simulations))]
        named = zip(train.constraint_names, kinds, values, strict=True)
        print_table(console, ["constraint", "must be", "at the start"], named)


def check(options: Namespace) -> int:
    """Read everything, try the FMU out in processes of its own, print a page; change nothing."""
    console, path = Console(), options.config
    seconds = SECONDS if options.seconds is None else options.seconds
    if path.suffix.lower() == ".fmu":
        bare = bare_problem(path)
        print_model(console, bare, "its own start values")
        build_core()
        page = run_checks(bare, Resources(), seconds, declared=False)
        print_page(console, page)
        return _verdict(page)
    run = read_study(path, options.overrides, RunKind.FIT, allow_code=options.allow_code)
    config, problem = run.config, run.identity.problem
    resources = build_resources(config)
    for sentence in resources.notes():
        complain(sentence)
    print_model(console, problem, f"method {config.method.name}")
    build_core()
    page = run_checks(problem, resources, seconds)
    declared = [
        *sigma_findings(config, problem.describe()),
        *unit_findings(config, problem.describe(), problem.tables),
        *(passed("long records", f"for a fit and other steps {each}") for each in run.notes),
        *long_records(config, problem),
    ]
    page = replace(page, findings=(*page.findings, *declared))
    if page.simulations:
        print_check(console, problem, page.simulations)
    print_page(console, page)
    return _verdict(page)


def _verdict(page: CheckPage) -> int:
    if not page.loads:
        raise ModelError(page.findings[0].found)
    return ExitCode.DONE if page.good else ExitCode.NO_SOLUTION
