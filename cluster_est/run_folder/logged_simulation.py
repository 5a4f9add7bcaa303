"""A logged simulation, repeated in a separate process that shows the messages of the FMU."""

from __future__ import annotations

import math
import tomllib
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from cluster_est.closed_loop.long_records import ways_to_thin
from cluster_est.config.build import build_problem
from cluster_est.config.choices import build_resources
from cluster_est.config.reader import config_folder, read_config
from cluster_est.config.sections import Config, EffectSection
from cluster_est.errors import ConfigError, RunFolderError
from cluster_est.executors.log_replay import simulation_key
from cluster_est.problem.problem import Problem
from cluster_est.problem.variables import coefficient_names
from cluster_est.run_folder.log_segment import logged_cost, read_log, residuals_hash
from cluster_est.run_folder.run_files import is_ended, read_config_text, read_facts
from cluster_est.running.reset_policy import recorded
from workers.fmu.description import nearest
from workers.messages import Effect, FloatArray, Limits, Outcome, Status, Task, Want
from workers.process.supervisor import SupervisedEvaluator

FACTS = ["search", "evaluation", "purpose", "experiment", "status", "message", "cost"]
"""Small columns of the log."""


@dataclass(frozen=True)
class LoggedSimulation:
    """A row of the log of a run.

    Attributes
    ----------
    number
        Number of the row, from 0; on the command line, its ID.
    search, evaluation, purpose, experiment
        The search that requested it, and the simulated experiment.
    status, message, cost
        Its result; the cost is the sum of the function `summed`, NaN for a failure.
    key
        Hash of everything on which it depends.
    want, values, effects
        The task; effects by name.
    residuals, residuals_hash
        None if it failed, or if the log does not contain them.
    bound
        Sum of squares above which it should end early.
    """

    number: int
    search: str
    evaluation: int
    purpose: str
    experiment: str
    status: str
    message: str
    cost: float
    key: str = ""
    want: Want = "residuals"
    values: FloatArray = field(default_factory=lambda: np.zeros(0))
    effects: tuple[str, ...] = ()
    residuals: FloatArray | None = None
    residuals_hash: str | None = None
    bound: float = math.inf

    @property
    def ok(self) -> bool:
        return self.status == Status.OK

    @property
    def failed(self) -> bool:
        """Whether it neither reached its end nor was ended early."""
        return Status(self.status).is_failure

    @property
    def summed(self) -> str:
        """The function of the residuals whose sum is the cost."""
        return "absolute values" if self.want == "absolutes" else "squares"


@dataclass(frozen=True)
class ReplayRequest:
    """A logged simulation, ready to be repeated.

    Attributes
    ----------
    problem, limits
        From the run's config.
    task
        Task of the worker; its experiment is an index of those of the problem.
    same
        Whether model, solver, data and effects are those of the run.
    """

    problem: Problem
    limits: Limits
    task: Task
    same: bool

    @property
    def named_values(self) -> list[tuple[str, float]]:
        """Each value with its parameter, and the FMU's name if it differs."""
        problem = self.problem
        named = {p.target: p.name for p in problem.parameters}
        targets = [*problem.model.parameters]
        for effect in self.task.effects:
            targets += [f"{effect.name}.{name}" for name in coefficient_names(effect)]
        labels = [t if named[t] == t else f"{named[t]} ({t})" for t in targets]
        return list(zip(labels, self.task.values.tolist(), strict=True))


def read_logged(run_folder: Path, number: int) -> LoggedSimulation:
    """Read one row of a run's log.

    Raises
    ------
    RunFolderError
        If there is no log or no such row.
    """
    table = _read(run_folder)
    if not 0 <= number < table.num_rows:
        raise RunFolderError(
            f"{run_folder}: the ID of a simulation must be a row of the log, from 0 to "
            f"{table.num_rows - 1}, but is {number}; `cluster-est show {run_folder} --failures` "
            "lists the simulations that failed"
        )
    (row,) = table.slice(number, 1).to_pylist()
    residuals = row["residuals"]
    small: list[Any] = [row[name] for name in FACTS]
    return replace(
        LoggedSimulation(number, *small),
        key=row["key"],
        want=cast(Want, row["want"]),
        values=np.array(row["values"], dtype=np.float64),
        effects=tuple(row["effects"]),
        residuals=None if residuals is None else np.array(residuals, dtype=np.float64),
        residuals_hash=row["residuals_hash"],
        bound=math.inf if row["bound"] is None else row["bound"],
    )


def read_failures(run_folder: Path) -> list[LoggedSimulation]:
    """Read the failed rows of a run's log, without their tasks.

    Raises
    ------
    RunFolderError
        If there is no log.
    """
    columns = _read(run_folder).select(FACTS).to_pydict()
    rows = zip(*columns.values(), strict=True)
    found = (LoggedSimulation(number, *row) for number, row in enumerate(rows))
    return [logged for logged in found if logged.failed]


def _read(run_folder: Path) -> Any:
    ended = is_ended(read_facts(run_folder))  # raises an error if this is not a run
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the truncated end of a killed run
        return read_log(run_folder / "evaluations", ended=ended)


def prepare(
    run_folder: Path, logged: LoggedSimulation, config: Path | None, *, allow_code: bool
) -> ReplayRequest:
    """Read the inputs of a run again.

    Parameters
    ----------
    run_folder, logged
        The run, and a row of its log.
    config
        The original config of the run, to whose folder its paths are relative. None if the run
        recorded that folder.
    allow_code
        Whether Python functions named in the config may run.

    Raises
    ------
    ClusterEstError
        If something is missing, or if the row was simulated with effects that are not in the
        config.
    """
    read_config_text(run_folder)  # raises an error if the config is damaged
    resolved = read_config(run_folder / "config.toml")
    base = config_base(run_folder, config)
    whole = build_problem(resolved, base, allow_code=allow_code)
    where = f"{run_folder}, evaluation {logged.number}"
    ids = [experiment.id for experiment in whole.experiments]
    if logged.experiment not in ids:
        raise RunFolderError(
            f"{where}: its experiment must be in the config, but is "
            f"{logged.experiment!r}{nearest(logged.experiment, ids)}"
        )
    index = ids.index(logged.experiment)
    effects = _effects(whole, logged, where)
    counts = [len(coefficient_names(effect)) for effect in effects]
    wanted = len(whole.model.parameters) + sum(counts)
    if len(logged.values) != wanted:
        raise RunFolderError(
            f"{where}: has {len(logged.values)} values, but {run_folder / 'config.toml'} expects "
            f"{wanted}; the file was changed after the run, so restore it"
        )
    same = False
    for problem in _with_rows_of_run(whole, resolved):
        known = problem.model.key, problem.experiments[index].key
        same = simulation_key(*known, effects, logged.values, logged.bound) == logged.key
        if same:
            break
    problem = problem if same else whole
    if problem.model.reset == "auto":
        chosen = recorded(read_facts(run_folder))
        if chosen is not None:
            problem = replace(problem, model=replace(problem.model, reset=chosen.policy))
    task = Task(0, index, logged.values, logged.want, effects, logged.bound)
    resources = build_resources(resolved)
    problem = replace(problem, model=resources.limited(problem.model).of_worker(0))
    return ReplayRequest(problem, resources.limits, task, same)


def _with_rows_of_run(problem: Problem, config: Config) -> Iterator[Problem]:
    """Yield the problem with all rows, then with thinned records that the run may have used."""
    yield problem
    ways = ways_to_thin(problem, config.thinning.most(), build_resources(config))
    for found, corrected in ways:
        yield found.problem
        if corrected is not None:
            yield corrected.problem


def config_base(run_folder: Path, config: Path | None) -> Path:
    """Return the folder to which the paths in the run's config are relative."""
    if config is not None:
        if not config.is_file():
            raise ConfigError(f"--config: there is no config file {config}; check the path")
        return config_folder(config)
    known = read_facts(run_folder).get("config_folder")
    if not isinstance(known, str):
        raise RunFolderError(
            f"{run_folder}: does not record the folder to which paths in its config are relative; "
            "name the original config with --config"
        )
    if not Path(known).is_dir():
        raise RunFolderError(
            f"{run_folder}: its config was in {known}, which does not exist on this machine; name "
            "the config with --config"
        )
    return Path(known)


def with_found_effects(config: Config, facts: Mapping[str, Any]) -> Config:
    """Return a config with the effects that a closed loop added, as its run.json records them."""
    declared = {section.name or section.form for section in config.effects}
    found = [tomllib.loads(each["config"])["effects"][0] for each in facts.get("effects", [])]
    added = [EffectSection(**each) for each in found if each["name"] not in declared]
    return config.model_copy(update={"effects": [*config.effects, *added]}) if added else config


def _effects(problem: Problem, logged: LoggedSimulation, where: str) -> tuple[Effect, ...]:
    known = {effect.name: effect for effect in problem.effects}
    for name in logged.effects:
        if name not in known:
            raise RunFolderError(
                f"{where}: its effects must be in the config, but {name!r}, which the search for "
                "missing effects tried, is not; add it to the config and run fit or check"
            )
    return tuple(known[name] for name in logged.effects)


def replay(question: ReplayRequest) -> Outcome:
    """Simulate once in a separate process, which writes the FMU's messages to stderr.

    Raises
    ------
    ModelError
        If the FMU cannot be loaded, or its process ends during loading.
    """
    problem, task = question.problem, question.task
    model = replace(problem.model, logging_on=True)
    guard = SupervisedEvaluator(
        model, (problem.experiments[task.experiment],), "replay", question.limits
    )
    try:
        return guard.once(replace(task, experiment=0))
    finally:
        guard.close()


def comparison(logged: LoggedSimulation, outcome: Outcome) -> str:
    """Return a sentence that compares an outcome with the logged one."""
    if not logged.ok or outcome.residuals is None:
        if (logged.failed, outcome.failed) == (False, False):
            same = logged.message == outcome.message
            return (
                "the simulation was ended early, as in the run"
                if same
                else "the simulation does not end as in the run"
            )
        if logged.failed is outcome.failed:
            same = (logged.status, logged.message) == (outcome.status, outcome.message)
            return (
                "the simulation failed as in the run"
                if same
                else "the simulation failed, as in the run, but with another message"
            )
        return (
            "the simulation failed in the run, but does not fail now"
            if logged.failed
            else "the simulation failed now, but did not fail in the run"
        )
    now = outcome.residuals
    known = logged.residuals_hash or residuals_hash(logged.residuals)
    if known is not None and known == residuals_hash(now):
        return "the residuals agree with the logged ones bit for bit"
    if logged.residuals is None:
        cost = logged_cost(outcome, logged.want)
        same, gap = cost == logged.cost, cost - logged.cost
        how = "are the same as now" if same else f"differ by {gap:.3g}"
        kept = "; their hashes differ, and" if known is not None else ";"
        return f"the log does not keep the residuals{kept} the sums of {logged.summed} {how}"
    then = logged.residuals
    if len(then) != len(now):
        return f"there were {len(then)} residuals in the run, but there are {len(now)} now"
    most = float(np.max(np.abs(then - now)))
    return f"{np.count_nonzero(then != now)} of {len(now)} residuals differ, by at most {most:.3g}"
