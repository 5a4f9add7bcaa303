"""The command design: the input of the next experiment."""

from __future__ import annotations

import io
from argparse import Namespace
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv

from cluster_est.cli.answer import Answer
from cluster_est.cli.printed_runs import print_any_run
from cluster_est.cli.terminal import EXIT_CODES, build_core, run_as_told, say_report
from cluster_est.errors import RunFolderError
from cluster_est.experiment_design.design_sentences import block_for_table
from cluster_est.run_folder.run_files import read_facts, read_run_columns
from cluster_est.studies.configured_design import read_design
from cluster_est.whole_files import write_output


def design(options: Namespace, answer: Answer) -> int:
    """Choose an input, write it as a table, and its run folder beside that."""
    out, folder = options.out, options.out.with_suffix("")
    _check_free(options)
    run = read_design(
        options.run_folder,
        options.limits,
        options.config,
        options.overrides,
        options.predict,
        allow_code=options.allow_code,
    )
    build_core(answer)
    end = run_as_told(run, folder, options, answer)
    if end.stopped:
        answer.add(run=folder, run_status=end.status, message=end.stopped)
        return EXIT_CODES[end.status]
    content = io.BytesIO()
    pacsv.write_csv(read_run_columns(folder / "next_input.parquet"), content)
    write_output(out, content.getvalue())
    print_any_run(answer, folder)
    say_report(answer, folder)
    answer.say("the lines that add the experiment to the config:\n")
    block = read_facts(folder)["design"]["block"]
    base = run.identity.base
    block = block_for_table(block, out, None if base is None else str(base))
    answer.say(block)
    answer.add(out=out, block=block)
    return EXIT_CODES[end.status]


def has_measurements(path: Path) -> bool:
    """Return whether the last column of a table of a next experiment contains values."""
    if not path.is_file():
        return False
    try:
        last = pacsv.read_csv(path).columns[-1]
    except (pa.ArrowException, IndexError):
        return True  # a changed file counts as filled
    return bool(last.null_count < len(last))


def _check_free(options: Namespace) -> None:
    """Refuse a table or its run folder if it contains data that must not be replaced.

    Raises
    ------
    RunFolderError
        With the path concerned.
    """
    out, folder = options.out, options.out.with_suffix("")
    if out.suffix.lower() != ".csv":
        raise RunFolderError(f"--out: must end in .csv, but is {out.name!r}; rename it")
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise RunFolderError(
            f"--out: must be a file in an existing folder, but is {out}; choose another file"
        )
    if has_measurements(out):
        raise RunFolderError(
            f"--out: {out} contains measurements, which are not overwritten; choose another file"
        )
    if out.exists() and not (options.overwrite or options.resume):
        raise RunFolderError(
            f"--out: {out} exists already; choose another file, or replace it with --overwrite"
        )
    run, own = options.run_folder.resolve(), folder.resolve()
    if own == run or run in own.parents or own in run.parents:
        raise RunFolderError(
            f"--out: the run folder for {out} would be {folder}, but this folder contains or is "
            "the run to read; choose another name"
        )
    facts = read_facts(folder) if (folder / "run.json").is_file() else {}
    if facts.get("verdict") or (folder / "parameters.parquet").is_file():
        raise RunFolderError(
            f"--out: {folder} contains a run that is not a design; choose another name"
        )
