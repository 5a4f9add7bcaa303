"""The command design: the input of the next experiment."""

from __future__ import annotations

from argparse import Namespace

import pyarrow.csv as pacsv
from rich.console import Console

from cluster_est.cli.display.closed_loop import print_any_run
from cluster_est.cli.display.run import say
from cluster_est.cli.estimate import EXIT_CODES
from cluster_est.cli.terminal import complain, say_if_compiled_first, terminal_listener
from cluster_est.configured_design import read_design
from cluster_est.configured_run import Destination, do_run
from cluster_est.errors import RunFolderError
from cluster_est.run_folder.context import Existing
from cluster_est.run_folder.reading import read_run_columns
from cluster_est.run_folder.run_status import RunStatus


def design(options: Namespace) -> int:
    """Choose an input, write it as a table, and its run folder beside that."""
    out = options.out
    if out.suffix.lower() != ".csv":
        raise RunFolderError(f"--out: must end in .csv but is {out.name!r}; rename it")
    if out.exists() and not (options.overwrite or options.resume):
        raise RunFolderError(f"--out: {out} is there already; choose another, or --overwrite")
    run = read_design(
        options.run_folder, options.limits, options.config, allow_code=options.allow_code
    )
    existing = Existing.OVERWRITE if options.overwrite else Existing.REFUSE
    existing = Existing.RESUME if options.resume else existing
    folder = out.with_suffix("")
    say_if_compiled_first()
    end = do_run(
        run, Destination(folder, existing, report=not options.no_report), terminal_listener()
    )
    if end.stopped:
        complain(end.stopped)
        return EXIT_CODES[end.status]
    if end.status is RunStatus.DONE:
        try:
            pacsv.write_csv(read_run_columns(folder / "next_input.parquet"), out)
        except OSError as error:
            raise RunFolderError(
                f"--out: {out} cannot be written ({error}); choose another"
            ) from error
    print_any_run(Console(), folder)
    if (folder / "report.html").is_file():
        say(Console(), f"report: {folder / 'report.html'}")
    say(Console(), f"next experiment: {out}; measure the empty columns and write them there")
    return EXIT_CODES[end.status]
