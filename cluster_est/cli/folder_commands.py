"""The commands on a run folder: show, report and export."""

from __future__ import annotations

import sys
from argparse import Namespace

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printed_runs import print_any_run
from cluster_est.cli.printing import print_iterations


def show(options: Namespace, answer: Answer) -> int:
    """Print the tables of a run, what failed in it, or one search's iterations."""
    run_folder = options.run_folder
    if options.failures:
        from cluster_est.cli.replay_command import print_failures

        print_failures(answer, run_folder)
    elif options.iterations or options.search is not None:
        print_iterations(answer, run_folder, options.search)
    else:
        print_any_run(answer, run_folder)
    return ExitCode.DONE


def report(options: Namespace, answer: Answer) -> int:
    """Write the report of a run or of a sweep."""
    # Jinja is imported only if needed
    from cluster_est.html_report.page import write_report
    from cluster_est.html_report.sweep_page import is_sweep, write_sweep_report

    write = write_sweep_report if is_sweep(options.run_folder) else write_report
    written = write(options.run_folder, options.out)
    answer.add(out=written)
    answer.say(f"report: {written}")
    return ExitCode.DONE


def export(options: Namespace, answer: Answer) -> int:
    """Write what a run has found, in the forms that are asked for."""
    from cluster_est.model_export.write import ExportRequest
    from cluster_est.model_export.write import export as run_export  # SymPy is slow to import

    wanted = ExportRequest(
        options.fmu, options.ssv, options.csv, options.modelica, options.text, not options.no_step
    )
    written = run_export(
        options.run_folder,
        options.config,
        options.experiment,
        wanted,
        allow_code=options.allow_code,
    )
    for printed in written.printed:
        answer.say(printed)
    for note in written.notes:
        answer.complain(note)
    answer.add(files=written.files)
    for path in written.files:
        print(path, file=sys.stderr)
    return ExitCode.DONE
