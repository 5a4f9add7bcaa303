"""What the commands do. Only this file and the display print."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.feather
import pyarrow.parquet
from rich.console import Console

from cluster_est.build import build_method, build_problem, build_resources
from cluster_est.config import Config, read_config
from cluster_est.errors import ClusterEstError, RunFolderError
from cluster_est.fit import check_method
from cluster_est.fit import fit as run_fit
from cluster_est.fit import simulate as run_simulate
from cluster_est.printing import print_check, print_run
from cluster_est.problem import Problem
from cluster_est.progress import ProgressLine
from cluster_est.resources import Resources
from cluster_est.run_folder import (
    RunFolder,
    check_free,
    hash_config,
    residual_table,
    trajectory_table,
)
from cluster_est.runner import Origin, Snapshot
from cluster_est.space import make_space
from cluster_est.toml import to_toml
from workers.messages import Outcome

DONE, NO_SOLUTION, INTERRUPTED = 0, 1, 130


def check(path: Path, overrides: list[str]) -> int:
    """Read everything, simulate each experiment once, print a page; change nothing."""
    config = read_config(path, overrides)
    problem = build_problem(config, path.parent)
    method = build_method(config)
    check_method(method, make_space(problem, problem.indices("train")))
    make_space(problem, problem.indices("test"))
    simulations = run_simulate(problem, Resources())
    print_check(Console(), problem, method, simulations)
    return DONE if all(s.outcome.ok for s in simulations) else NO_SOLUTION


def fit(path: Path, overrides: list[str], out: Path, *, overwrite: bool) -> int:
    """Estimate, write the run folder, print the tables."""
    config = read_config(path, overrides)
    problem = build_problem(config, path.parent)
    method, resources = build_method(config), build_resources(config)
    check_method(method, make_space(problem, problem.indices("train")))
    make_space(problem, problem.indices("test"))
    check_free(out, overwrite=overwrite)
    folder: RunFolder | None = None

    def record(origin: Origin, outcome: Outcome) -> None:
        nonlocal folder
        if folder is None:  # the workers have started: from here on there is something to keep
            folder = _open_folder(out, problem, config, overwrite=overwrite)
        folder.record(origin, outcome)

    with ProgressLine(Console(stderr=True), resources.budget) as line:

        def show(snapshot: Snapshot) -> None:
            line.show(snapshot)
            if folder is not None:
                folder.show(snapshot)

        try:
            result = run_fit(problem, method, resources, config.method.seed, record, show)
        except ClusterEstError as error:
            if folder is not None:
                folder.abandon(str(error))
            raise
        except KeyboardInterrupt:
            if folder is not None:
                folder.abandon("interrupted before the search had begun")
            raise
    if folder is not None:
        folder.write(result)
    print_run(Console(), out)
    if result.interrupted:
        return INTERRUPTED
    return DONE if result.success else NO_SOLUTION


def simulate(path: Path, overrides: list[str], out: Path, run_folder: Path | None) -> int:
    """Simulate every experiment and write one table of trajectories."""
    config = read_config(path, overrides)
    writer = _table_writer(out)
    problem = build_problem(config, path.parent)
    values = read_estimates(run_folder) if run_folder is not None else {}
    simulations = run_simulate(problem, build_resources(config), values)
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
        return NO_SOLUTION
    measured = residual_table(problem, good).drop_columns(["simulated", "role"])
    table = trajectory_table(problem, good).join(measured, ["experiment", "output", "time"])
    order = [("experiment", "ascending"), ("output", "ascending"), ("time", "ascending")]
    out.parent.mkdir(parents=True, exist_ok=True)
    writer(table.sort_by(order), out)
    Console(soft_wrap=True).print(f"{out}: {table.num_rows} rows", markup=False, highlight=False)
    return DONE if len(good) == len(simulations) else NO_SOLUTION


def show(run_folder: Path) -> int:
    """Print the tables of a run."""
    print_run(Console(), run_folder)
    return DONE


def read_estimates(run_folder: Path) -> dict[str, float]:
    """Physical values by label from a run's parameters.parquet."""
    path = run_folder / "parameters.parquet"
    if not path.is_file():
        raise RunFolderError(f"{run_folder}: must be the folder of a finished run but is not")
    rows = pa.parquet.read_table(path).to_pylist()
    return {row["label"]: row["value"] for row in rows if row["estimated_on"] != "known"}


def _open_folder(out: Path, problem: Problem, config: Config, *, overwrite: bool) -> RunFolder:
    tree = config.model_dump(mode="json", exclude_defaults=False)
    return RunFolder(
        out,
        problem,
        to_toml(config.model_dump(mode="python")),
        hash_config(tree),
        config.method.seed,
        overwrite=overwrite,
    )


def _table_writer(out: Path):  # type: ignore[no-untyped-def]
    writers = {
        ".parquet": pa.parquet.write_table,
        ".feather": pa.feather.write_feather,
        ".csv": pa.csv.write_csv,
    }
    if out.suffix.lower() not in writers:
        raise RunFolderError(
            f"--out: must end in one of {', '.join(writers)} but is {out.name!r}; rename it"
        )
    return writers[out.suffix.lower()]
