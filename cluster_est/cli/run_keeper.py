"""A run's folder as commands keep it: begun with the first simulation, ended whatever happens.

What it has to say on the way goes to this terminal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console

from cluster_est.cli.printing import read_facts, say
from cluster_est.config.build import build_resources
from cluster_est.config.reader import Config
from cluster_est.problem.problem import Problem
from cluster_est.run_folder.folder import RunFolder, check_free
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.run_folder.resume import check_resumable, is_finished, open_folder
from cluster_est.running.reset_policy import ResetDecision, recorded
from cluster_est.running.resources import Resources
from cluster_est.running.runner import RunSnapshot, SearchIteration, Show, TaskOrigin
from workers.messages import Outcome

STEPS = {
    "weights": "weighting the outputs",
    "base": "fitting the declared model",
    "leave one out": "predicting experiments that were left out",
    "course": "screening the candidates",
    "trial": "trying candidates",
    "candidate": "refitting candidates",
    "enlarged": "simulating with larger inputs",
    "return": "fitting the declared model again",
    "swap": "revising the effects",
    "drop": "revising the effects",
    "final": "the final fits",
}
"""What the searches of a closed loop do, by their names in the log."""


class Keeper:
    """Opens the run folder with the first simulation, so that bad input leaves nothing behind.

    `logged` is what a run that is resumed has simulated already; `finished` is whether nothing is
    left to do.
    """

    def __init__(
        self,
        out: Path,
        problem: Problem,
        config: Config,
        base: Path,
        unused: str,
        *,
        overwrite: bool,
        resume: bool,
        with_report: bool = True,
    ) -> None:
        self._out, self._with_report = out, with_report
        self._searches: dict[str, None] = {}
        self.folder: RunFolder | None = None
        self.logged: LoggedOutcomes | None = None
        self.chosen: ResetDecision | None = None
        self._renew: ResetDecision | None = None
        self.finished = False
        if not resume:
            check_free(out, overwrite=overwrite)
        elif check_resumable(out, problem, config, unused):
            self.finished = is_finished(out)
            self.logged = None if self.finished else LoggedOutcomes(out / "evaluations")
            found = "holds a finished run"
            if self.logged is not None:
                found = f"is resumed; {len(self.logged)} simulations stand in its log"
                self._renew = recorded(read_facts(out))
            say(Console(stderr=True), f"cluster-est: {out} {found}")
        self._open: Callable[[], RunFolder] = lambda: open_folder(
            out,
            problem,
            config,
            unused,
            overwrite=overwrite,
            logged=self.logged,
            base=base,
            chosen=self.chosen,
        )

    def resources(self, config: Config) -> Resources:
        """Those of the config, behind what an interrupted run has left."""
        found = build_resources(config)
        return replace(
            found,
            log=self.logged,
            renew=self._renew,
            chosen=self._choose,
        )

    def _choose(self, chosen: ResetDecision) -> None:
        self.chosen = chosen
        if not chosen.plain:
            say(Console(stderr=True), f"cluster-est: {chosen.sentence}")

    @property
    def steps(self) -> str:
        """How far it came."""
        *done, last = dict.fromkeys(STEPS.get(name, name) for name in self._searches)
        return f"stopped while {last}" + (f", after {', '.join(done)}" if done else "")

    def record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        if self.folder is None:
            self.folder = self._open()
        self._searches.pop(origin.search, None)
        self._searches[origin.search] = None
        self.folder.record(origin, outcome)

    def shown(self, show: Show) -> Show:
        """Show on this terminal, and to who watches the folder."""

        def both(snapshot: RunSnapshot) -> None:
            show(snapshot)
            if self.folder is not None:
                self.folder.show(snapshot)

        return both

    def note(self, iteration: SearchIteration) -> None:
        if self.folder is not None:
            self.folder.note(iteration)

    def name_report(self) -> None:
        """Print where the report is, if there is one."""
        if (self._out / "report.html").is_file():
            say(Console(), f"report: {self._out / 'report.html'}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Say in the run folder how a run ended that did not end by itself."""
        if self.folder is not None and error is not None:
            stopped = isinstance(error, KeyboardInterrupt)
            status = "interrupted" if stopped else "failed"
            reason = status if stopped else str(error) or type(error).__name__
            self.folder.abandon(f"{reason}; {self.steps}", status)
        if self.folder is not None and self._with_report:
            _write_report(self._out)


def _write_report(run_folder: Path) -> None:
    """Write the report at the end of a run, without spoiling what the run has done."""
    try:
        from cluster_est.report import write_report

        write_report(run_folder)
    except Exception as error:
        said = str(error) or type(error).__name__
        say(Console(stderr=True), f"cluster-est: the report could not be written: {said}")
