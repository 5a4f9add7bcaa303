"""Executes a study from a config: read and check it, open or resume its folder, run, finish.

`cluster-est fit`, `close-loop`, `sensitivity` and every run of a sweep use `do_run`, so the same
config always gives the same bits and the same run.json.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from cluster_est.config.build import build_problem
from cluster_est.config.choices import build_method, build_resources
from cluster_est.config.reader import config_folder, original_config, read_config
from cluster_est.config.sections import Config
from cluster_est.errors import BudgetError, ProblemError, UnwritableError
from cluster_est.problem.problem import Problem
from cluster_est.problem.thinning import WHOLE_INPUTS, ThinnedProblem, thinned
from cluster_est.run_folder.context import ExistingRun, RunContext
from cluster_est.run_folder.run_files import RunStatus
from cluster_est.run_folder.run_folder import RunResult
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.environment import RunEnvironment, SharedPools, WorkerSource
from cluster_est.running.heartbeat import beating
from cluster_est.running.interrupts import stopped_by
from cluster_est.running.resources import Resources, Show
from cluster_est.running.study import Study
from cluster_est.sensitivity.analysis import Sensitivity
from cluster_est.studies.fit import Fit

STOP = "stop"
"""File in a run folder that ends the run like Ctrl-C."""


@dataclass(frozen=True)
class ConfiguredStudy:
    """A study from a config; everything is read and checked, but not simulated.

    Attributes
    ----------
    identity
        Kind, problem and hash of the study.
    config
        The config.
    study
        The study.
    notes
        Notes for the user on the data.
    """

    identity: RunIdentity
    config: Config
    study: Study[RunResult]
    notes: tuple[str, ...] = ()


def _fit(config: Config, problem: Problem) -> Study[RunResult]:
    return Fit(
        problem,
        build_method(config),
        config.method.seed,
        config.multistart,
        config.uncertainty,
        config.method.shooting,
    )


def _sensitivity(config: Config, problem: Problem) -> Study[RunResult]:
    return Sensitivity(problem, config.sensitivity, config.sensitivity.seed)


def _closed_loop(config: Config, problem: Problem) -> Study[RunResult]:
    from cluster_est.closed_loop.loop import ClosedLoop  # needs SymPy, which is slow

    return ClosedLoop(problem, config.closed_loop, config.closed_loop.seed, config.thinning)


STUDIES: dict[RunKind, Callable[[Config, Problem], Study[RunResult]]] = {
    RunKind.FIT: _fit,
    RunKind.SENSITIVITY: _sensitivity,
    RunKind.CLOSED_LOOP: _closed_loop,
}
"""Functions that make a study from a config."""


@dataclass(frozen=True)
class Listener:
    """Functions that receive messages and progress of a run.

    Attributes
    ----------
    say
        Called with notes for the user.
    progress
        Makes a context that displays the progress of the run, for its resources.
    alive
        Makes a context that displays an activity after the run.
    """

    say: Callable[[str], None]
    progress: Callable[[Resources], AbstractContextManager[Show]]
    alive: Callable[[str], AbstractContextManager[None]] = lambda _: nullcontext()


@dataclass(frozen=True)
class Destination:
    """The folder of a run, and what is written to it.

    Attributes
    ----------
    out
        The run folder.
    existing
        Treatment of an existing run.
    report
        Whether report.html is written at the end.
    begin_at_once
        Whether the folder is opened before the first simulation, so that it exists also after an
        earlier failure.
    """

    out: Path
    existing: ExistingRun = ExistingRun.REFUSE
    report: bool = True
    begin_at_once: bool = False


@dataclass(frozen=True)
class RunEnd:
    """The end of a run.

    Attributes
    ----------
    status
        Status as in run.json.
    stopped
        The reason why there is no result; "" if there is a result, also an earlier one.
    """

    status: RunStatus
    stopped: str = ""


def read_study(
    path: Path, overrides: list[str], kind: RunKind, *, allow_code: bool
) -> ConfiguredStudy:
    """Read and check a config.

    Raises
    ------
    ClusterEstError
        If the config has errors.
    """
    return configure(read_config(path, overrides), path, kind, allow_code=allow_code)


def configure(config: Config, path: Path, kind: RunKind, *, allow_code: bool) -> ConfiguredStudy:
    """Check the resolved config of a file.

    Raises
    ------
    ClusterEstError
        If the config has errors.
    """
    base = config_folder(path)
    problem = build_problem(config, base, allow_code=allow_code)
    thin = thinned_for(kind, config, problem)
    study = STUDIES[kind](config, thin.problem)
    study.check()
    notes = (thin.sentence,) if thin.is_thinner else ()
    identity = RunIdentity.of(kind, config, base, thin.problem, original_config(path))
    return ConfiguredStudy(identity, config, study, notes)


def thinned_for(kind: RunKind, config: Config, problem: Problem) -> ThinnedProblem:
    """Thin the records of a study that uses thinned records throughout.

    Inputs keep all of their samples, so the simulations need not be compared with those of whole
    records. A closed loop makes this comparison: it thins records itself, and reports on all rows.
    """
    if kind is RunKind.CLOSED_LOOP:
        return thinned(problem, None)
    most = config.thinning.most(auto=kind is not RunKind.FIT)
    return thinned(problem, most, WHOLE_INPUTS)


def do_run(
    run: ConfiguredStudy,
    to: Destination,
    listener: Listener,
    source: WorkerSource | None = None,
) -> RunEnd:
    """Open or resume a run's folder, run, and write the results.

    Parameters
    ----------
    run
        The study.
    to
        The folder for its results.
    listener
        Receives messages and progress.
    source
        Source of the workers; the run's own workers if None.

    Raises
    ------
    RunFolderError
        If the folder contains files that may not be replaced, or another run than that to resume.
    ClusterEstError
        If model, experiments or resources are invalid.
    KeyboardInterrupt
        If it is interrupted before the first simulation.
    """
    resources = build_resources(run.config)
    said = (*resources.notes(), *run.identity.problem.data_notes(), *run.notes)
    for sentence in said:
        listener.say(sentence)
    to = replace(to, out=to.out.absolute())  # an FMU may change the working folder of this process
    context = RunContext(run.identity, to.out, to.existing, listener.say)
    if context.finished:
        return RunEnd(RunStatus.DONE)
    if to.begin_at_once:
        context.begin()
    # workers end after all results are written, because an FMU may crash when it is freed
    own = SharedPools() if source is None else nullcontext(source)
    try:
        with (
            own as workers,
            listener.progress(resources) as show,
            context,
            stopped_by(to.out / STOP),
            ExitStack() as stack,
        ):
            monitor = context.monitor(show)
            shown = stack.enter_context(beating(monitor.show or show))
            monitor = replace(monitor, show=shown)
            environment = RunEnvironment(resources, monitor, context.earlier, workers)
            result = run.study.run(environment)
            if context.folder is None and getattr(result, "interrupted", False):
                raise KeyboardInterrupt  # keep an existing run, because nothing was simulated
            status = context.finish(result)
    except UnwritableError:
        to = replace(to, report=False)  # the report cannot be written either
        raise
    except (KeyboardInterrupt, BudgetError, ProblemError) as error:
        if context.folder is None:  # nothing was simulated, so the input is invalid
            raise
        return _stopped(error, context)
    finally:
        if to.report and context.folder is not None:
            with listener.alive("writing the report"):
                _write_report(to.out, listener)
    return RunEnd(status)


def _stopped(error: BaseException, context: RunContext) -> RunEnd:
    """Return the end of a run without a result, after simulations that are in its log."""
    interrupted = isinstance(error, KeyboardInterrupt)
    why = "interrupted" if interrupted else str(error)
    status = RunStatus.INTERRUPTED if interrupted else RunStatus.FAILED
    if context.has_results:  # the results so far are shown instead of a sentence
        return RunEnd(RunStatus.INTERRUPTED)
    return RunEnd(status, f"{why}; {context.steps}; the log is in {context.out}")


def _write_report(run_folder: Path, listener: Listener) -> None:
    """Write the report at the end of a run; a failure does not affect the run."""
    try:
        from cluster_est.html_report.page import (
            write_report,  # Jinja is slow to import
        )

        write_report(run_folder)
    except Exception as error:
        said = str(error) or type(error).__name__
        listener.say(f"the report could not be written: {said}")
