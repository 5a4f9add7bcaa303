"""Measured and simulated curves of a run: those in its folder, or those of the best point.

A closed loop writes its curves after each round, and a fit at its end. Before that, the best point
of a fit is simulated here in a separate process, if this takes few seconds. The run itself stores
no intermediate curves, so it is not influenced by observers.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc

from cluster_est.config.build import build_problem
from cluster_est.config.choices import build_resources
from cluster_est.config.reader import read_config
from cluster_est.errors import ClusterEstError, RunFolderError
from cluster_est.html_report.curve_section import extremes
from cluster_est.html_report.number_text import duration
from cluster_est.html_report.recorded_curves import OutputCurves, recorded_curves
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.results.output_errors import compared_values, measured_values
from cluster_est.run_folder.logged_simulation import config_base
from cluster_est.run_folder.run_files import is_ended, read_config_text, read_run_columns
from cluster_est.running.reset_policy import recorded
from cluster_est.running.resources import BestPoint
from workers.messages import FloatArray, Limits, Outcome, Output, Task
from workers.process.supervisor import SupervisedEvaluator

CURVE_COLUMNS = 500
"""Number of columns of a chart, each of which shows the lowest and the highest sample."""
MOST_SECONDS_TO_REPEAT = 5.0
"""Longest average duration of the run's simulations for which a simulation is repeated."""

SHOWN_LATER = "the curves are shown when the run has a result"

NOT_YET = "There are no curves yet: they are shown from the first point of the first fit on."

OF_MODEL = "Simulated for this page with the {}, as it was fitted first."


@dataclass(frozen=True)
class OutputCurve:
    """One output at measured times, and simulated at finer times if available.

    `before` is empty if unknown.
    """

    name: str
    time: FloatArray = field(repr=False)
    measured: FloatArray = field(repr=False)
    fine: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)


@dataclass(frozen=True)
class ExperimentCurves:
    """The curves of one experiment.

    Attributes
    ----------
    experiments
        The available experiments.
    experiment
        The experiment of the curves; "" if there are none.
    outputs
        Its curves.
    said
        The point of the curves, or why there are none.
    """

    experiments: tuple[str, ...] = ()
    experiment: str = ""
    outputs: tuple[OutputCurve, ...] = ()
    said: str = ""


class CurveSource:
    """Provides the curves of a run while it is running and afterwards.

    Parameters
    ----------
    run_folder
        Folder of the run.
    config
        The original config of the run, if it has moved.
    allow_code
        Whether Python functions named in the config may run.
    """

    def __init__(self, run_folder: Path, config: Path | None, *, allow_code: bool) -> None:
        self._path, self._config, self._allow_code = run_folder, config, allow_code
        self._simulated: _BestSimulator | None = None
        self._of = ""
        self._asking = threading.Lock()

    def look(
        self,
        facts: Mapping[str, Any],
        best: BestPoint | None,
        seconds: float,
        wanted: str,
        model: str = "",
    ) -> ExperimentCurves:
        """Return the curves of an experiment.

        Parameters
        ----------
        facts
            Contents of run.json.
        best
            The best point so far, if there is one.
        seconds
            Average duration of a simulation.
        wanted
            The experiment; another one if there is none of that name.
        model
            The model of the best point, if it may differ from that of the result.
        """
        try:
            with self._asking:
                if is_ended(facts) or facts.get("verdict") is not None:
                    self.close()
                    return self._stored(facts, wanted)
                if best is None:
                    return ExperimentCurves(said=NOT_YET)
                if seconds > MOST_SECONDS_TO_REPEAT:
                    said = (
                        f"A simulation takes about {duration(seconds)}, which is too long for a "
                        "repetition"
                    )
                    return ExperimentCurves(said=f"{said} here; {SHOWN_LATER}.")
                found = self._simulator(facts).curves(best, wanted)
                told = model and found.outputs  # otherwise, it says why there are no curves
                return replace(found, said=OF_MODEL.format(model)) if told else found
        except (ClusterEstError, OSError) as error:
            return ExperimentCurves(said=f"The curves cannot be shown: {error}")

    def close(self) -> None:
        """End the simulating process, if there is one."""
        if self._simulated is not None:
            self._simulated.close()
        self._simulated = None

    def _simulator(self, facts: Mapping[str, Any]) -> _BestSimulator:
        if self._simulated is None or self._of != facts.get("started"):
            self.close()
            read_config_text(self._path)  # raises an error if the config is damaged
            config = read_config(self._path / "config.toml")
            base = config_base(self._path, self._config)
            problem = build_problem(config, base, allow_code=self._allow_code)
            chosen = recorded(facts)
            if problem.model.reset == "auto" and chosen is not None:
                problem = replace(problem, model=replace(problem.model, reset=chosen.policy))
            resources = build_resources(config)
            if resources.instances is not None:
                raise RunFolderError(
                    "the licence of the FMU limits its instances (executor.instances), and the run "
                    f"uses all of them; {SHOWN_LATER}"
                )
            self._simulated = _BestSimulator(problem, resources.limits)
            self._of = str(facts.get("started"))
        return self._simulated

    def _stored(self, facts: Mapping[str, Any], wanted: str) -> ExperimentCurves:
        """Return the curves in the folder."""
        path = self._path / "residuals.parquet"
        if not path.is_file():
            return ExperimentCurves(said="The folder of this run holds no curves.")
        table = read_run_columns(path)
        names = tuple(pc.unique(table["experiment"]).to_pylist())
        if not names:
            return ExperimentCurves(said="The folder of this run holds no curves.")
        experiment = wanted if wanted in names else names[0]
        finer = self._path / "trajectories.parquet"
        fine = read_run_columns(finer) if finer.is_file() else None
        found = recorded_curves({"residuals": table, "trajectories": fine}, experiment)
        ended = "At the estimates of this run." if is_ended(facts) else "As found so far."
        before = "the fitted declared model" if facts.get("verdict") is not None else "the start"
        kept = tuple(_thinned(name, c) for (_, name), c in found.items() if c.has_times)
        return ExperimentCurves(names, experiment, kept, f"{ended} Before: {before}.")


class _BestSimulator:
    """Simulates experiments at the best point of a fit; repeated only if the point has changed."""

    def __init__(self, problem: Problem, limits: Limits) -> None:
        self._problem = problem
        self._guard = SupervisedEvaluator(problem.model, problem.experiments, "watch", limits)
        labels = {u.label for u in make_space(problem, problem.indices("train")).unknowns}
        self._labels = labels
        self._best: BestPoint | None = None
        self._known: dict[int, ExperimentCurves] = {}

    def curves(self, best: BestPoint, wanted: str) -> ExperimentCurves:
        """Return the curves of an experiment at the best point.

        Raises
        ------
        RunFolderError
            If the search has other unknowns than the config.
        """
        if set(best.values) != self._labels:
            raise RunFolderError(
                f"the unknowns of the search differ from those of the config; {SHOWN_LATER}"
            )
        if self._best is None or best.values != self._best.values:
            self._best, self._known = best, {}
        problem = self._problem
        shown = [
            e for e in range(len(problem.experiments))
            if not make_space(problem, (e,), best.values).unknowns
        ]  # fmt: skip
        names = tuple(problem.experiments[e].id for e in shown)
        if not shown:
            return ExperimentCurves(said="No experiment has values for all of its unknowns yet.")
        e = shown[names.index(wanted) if wanted in names else 0]
        if e not in self._known:
            self._known[e] = self._simulate(e, best, names)
        return self._known[e]

    def _simulate(self, e: int, best: BestPoint, names: tuple[str, ...]) -> ExperimentCurves:
        problem = self._problem
        space, experiment = make_space(problem, (e,), best.values), problem.experiments[e]
        values = space.physical(space.start)[0]
        outcome = self._guard.once(Task(0, e, values, "trajectory", problem.effects))
        if not outcome.ok:
            said = f"This experiment cannot be simulated at the best point: {outcome.message}"
            return ExperimentCurves(names, experiment.id, (), said)
        curves = tuple(
            _thinned(o.variable, _curve_at(o, outcome)) for o in experiment.outputs if len(o.times)
        )
        said = "Simulated for this page at the best point so far."
        return ExperimentCurves(names, experiment.id, curves, said)

    def close(self) -> None:
        """End the process."""
        self._guard.close()


def _curve_at(output: Output, outcome: Outcome) -> OutputCurves:
    """Return one simulated output at the measured times."""
    found = compared_values(output, outcome)
    unknown = np.full(len(output.times), np.nan)
    after = unknown if found is None else found
    measured = measured_values(output, outcome)
    return OutputCurves("", output.times, measured, after, unknown, unknown)


def _thinned(name: str, curves: OutputCurves) -> OutputCurve:
    """Return the visible samples of each curve."""
    kept = extremes(curves.time, curves.measured, CURVE_COLUMNS)
    fine, after, before = curves.fine or (curves.time, curves.after, curves.before)
    pairs = [y for y in (after, before) if np.isfinite(y).any()]
    parts = [extremes(fine, y, CURVE_COLUMNS) for y in pairs]
    seen = np.unique(np.concatenate([np.zeros(0, np.int64), *parts]))
    known = before[seen] if np.isfinite(before).any() else np.zeros(0)
    return OutputCurve(
        name, curves.time[kept], curves.measured[kept], fine[seen], after[seen], known
    )
