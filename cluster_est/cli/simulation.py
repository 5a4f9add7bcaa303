"""The command simulate."""

from __future__ import annotations

import io
from argparse import Namespace
from functools import partial
from pathlib import Path

import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from pyarrow import feather
from rich.console import Console

from cluster_est.cli.exit_codes import ExitCode
from cluster_est.cli.terminal import complain
from cluster_est.config.build import build_problem
from cluster_est.config.choices import build_resources
from cluster_est.config.reader import read_config
from cluster_est.errors import RunFolderError
from cluster_est.fit import simulate as run_simulate
from cluster_est.problem.problem import Problem
from cluster_est.results.curves import residual_table, trajectory_table
from cluster_est.run_folder.reading import check_has_estimates, read_run_table
from cluster_est.whole_files import write_output


def simulate(options: Namespace) -> int:
    """Simulate every experiment and write one table of trajectories."""
    config, out = read_config(options.config, options.overrides), options.out
    resources = build_resources(config)
    for sentence in resources.notes():
        complain(sentence)
    writer = _table_writer(out)
    if out.is_dir():
        raise RunFolderError(f"--out: {out} must be a file but is a folder; choose another")
    problem = build_problem(config, options.config.parent, allow_code=options.allow_code)
    values = {} if options.run_folder is None else read_estimates(options.run_folder, problem)
    simulations = run_simulate(problem, resources, values)
    for simulation in simulations:
        if not simulation.outcome.ok:
            name = problem.experiments[simulation.experiment].id
            outcome = simulation.outcome
            Console(stderr=True, soft_wrap=True).print(
                f"cluster-est: experiment {name!r}: {outcome.status}: {outcome.message}",
                markup=False,
                highlight=False,
            )
    good = tuple(s for s in simulations if s.outcome.ok)
    if not good:
        return ExitCode.NO_SOLUTION
    measured = residual_table(problem, good).drop_columns(["simulated", "role"])
    table = trajectory_table(problem, good).join(measured, ["experiment", "output", "time"])
    order = [("experiment", "ascending"), ("output", "ascending"), ("time", "ascending")]
    content = io.BytesIO()
    writer(table.sort_by(order), content)
    write_output(out, content.getvalue())
    Console(soft_wrap=True).print(f"{out}: {table.num_rows} rows", markup=False, highlight=False)
    return ExitCode.DONE if len(good) == len(simulations) else ExitCode.NO_SOLUTION


def read_estimates(run_folder: Path, problem: Problem) -> dict[str, float]:
    """Physical values by label from a run's parameters.parquet.

    Raises
    ------
    RunFolderError
        If the run is not finished, or has estimated what the problem does not have: without an
        effect that the run has added, its other values mean little.
    """
    path = run_folder / "parameters.parquet"
    if not path.is_file():
        if (run_folder / "run.json").is_file():
            check_has_estimates(run_folder)
        raise RunFolderError(f"{run_folder}: must be the folder of a finished run but is not")
    rows = [r for r in read_run_table(path) if r["estimated_on"] in ("train", "test")]
    known = {parameter.name for parameter in problem.parameters}
    strange = list(dict.fromkeys(r["label"] for r in rows if r["parameter"] not in known))
    if strange:
        raise RunFolderError(
            f"--run: {run_folder} must have estimated what the config declares but has "
            f"{', '.join(strange)} besides; add the run's [[effects]] and parameters to the config"
        )
    return {row["label"]: row["value"] for row in rows}


def _table_writer(out: Path):  # type: ignore[no-untyped-def]
    writers = {
        ".parquet": partial(pq.write_table, write_page_checksum=True),
        ".feather": feather.write_feather,
        ".csv": pacsv.write_csv,
    }
    if out.suffix.lower() not in writers:
        raise RunFolderError(
            f"--out: must end in one of {', '.join(writers)} but is {out.name!r}; rename it"
        )
    return writers[out.suffix.lower()]
