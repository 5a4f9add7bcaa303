"""The command before a run: check."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace

from rich.console import Console

from cluster_est.cli.display.preflight import print_page
from cluster_est.cli.display.start import print_check, print_model
from cluster_est.cli.exit_codes import ExitCode
from cluster_est.cli.terminal import complain, say_if_compiled_first
from cluster_est.config.options import build_resources
from cluster_est.config.reader import Config
from cluster_est.configured_run import read_run
from cluster_est.drafting.mismatches import unit_mismatches
from cluster_est.errors import ModelError
from cluster_est.preflight import (
    SECONDS,
    CheckFinding,
    CheckPage,
    CheckVerdict,
    bare_problem,
    run_checks,
    sigma_findings,
)
from cluster_est.problem.problem import Problem
from cluster_est.run_folder.run_identity import RunKind
from cluster_est.running.resources import Resources
from cluster_est.toml import dotted


def check(options: Namespace) -> int:
    """Read everything, try the FMU out in processes of its own, print a page; change nothing."""
    console, path = Console(), options.config
    seconds = SECONDS if options.seconds is None else options.seconds
    if path.suffix.lower() == ".fmu":
        bare = bare_problem(path)
        print_model(console, bare, "its own start values")
        say_if_compiled_first()
        page = run_checks(bare, Resources(), seconds, declared=False)
        print_page(console, page)
        return _verdict(page)
    run = read_run(path, options.overrides, RunKind.FIT, allow_code=options.allow_code)
    config, problem = run.config, run.identity.problem
    resources = build_resources(config)
    for sentence in resources.notes():
        complain(sentence)
    print_model(console, problem, f"method {config.method.name}")
    say_if_compiled_first()
    page = run_checks(problem, resources, seconds)
    declared = [*sigma_findings(config, problem.describe()), *_units(config, problem)]
    page = replace(page, findings=(*page.findings, *declared))
    if page.simulations:
        print_check(console, problem, page.simulations)
    print_page(console, page)
    return _verdict(page)


def _units(config: Config, problem: Problem) -> list[CheckFinding]:
    """A line for each column whose name says another unit than its variable has."""
    return [
        CheckFinding(
            CheckVerdict.PROBLEM,
            "units",
            f"column '{m.column}' is given to {m.variable}, which is in {m.wanted}, as it is",
            f"{dotted('columns', m.column)} = {{ factor = {m.change.factor:.12g}, "
            f"offset = {m.change.offset:.12g} }}; with factor = 1 alone if the name is wrong",
        )
        for m in unit_mismatches(config, problem.describe())
    ]


def _verdict(page: CheckPage) -> int:
    if not page.loads:
        raise ModelError(page.findings[0].found)
    return ExitCode.DONE if page.good else ExitCode.NO_SOLUTION
