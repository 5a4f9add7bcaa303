"""The runs of a page: found in their folder, and read or stopped on request."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.errors import RunFolderError
from cluster_est.html_report.headline import command
from cluster_est.run_folder.run_files import RunStatus, left_alone, read_facts
from cluster_est.studies.configured import STOP
from cluster_est.watching.best_curves import CurveSource
from cluster_est.watching.follower import RunFollower, RunView
from cluster_est.watching.page_state import RunRow, curves_state, parameter_rows, run_state
from cluster_est.whole_files import ELSEWHERE, writing

SECONDS_BETWEEN_LOOKS = 0.5
"""Requests within this interval get the same answer."""
SECONDS_OF_INTEREST = 5.0
"""A page without a request for this time counts as closed."""
NOT_BEGUN = {"name": "", "status": "starting", "goes_on": True}


class FollowedRun:
    """A run that is read when a page requests it.

    Parameters
    ----------
    path, name
        Path and name of its folder.
    config, allow_code
        See `CurveSource`.
    """

    def __init__(self, path: Path, name: str, config: Path | None, *, allow_code: bool) -> None:
        self.path, self._name = path, name
        self._follower: RunFollower | None = None
        self._source = CurveSource(path, config, allow_code=allow_code)
        self._looking = threading.Lock()
        self._view: RunView | None = None
        self._state: dict[str, Any] = {}
        self._looked = -np.inf

    def state(self) -> dict[str, Any]:
        """Return all data of its page.

        Raises
        ------
        RunFolderError
            If a file is damaged.
        """
        with self._looking:
            if time.monotonic() - self._looked < SECONDS_BETWEEN_LOOKS:
                return self._state
            if self._follower is None and not (self.path / "run.json").is_file():
                return {**NOT_BEGUN, "name": self._name}
            self._follower = follower = self._follower or RunFollower(self.path)
            self._view = view = follower.look()
            activity = follower.tail.activity
            self._state = run_state(self._name, view, activity)
            for row in self._state["failures"]:
                row["command"] = command("replay", self.path, str(row["first"]))
            self._state["parameters"] = parameter_rows(self.path, view)
            self._looked = time.monotonic()
            return self._state

    def curves(self, experiment: str) -> dict[str, Any]:
        """Return the curves of one of its experiments."""
        self.state()
        if self._view is None or self._follower is None:
            return {"experiments": [], "experiment": "", "said": "", "outputs": []}
        view, seconds = self._view, self._follower.tail.activity.seconds
        average = float(np.mean(seconds)) if len(seconds) else 0.0
        found = self._source.look(
            view.facts, view.traces.shown, average, experiment, view.traces.shown_model
        )
        return curves_state(found, view.facts)

    def close(self) -> None:
        """Release the resources of its page."""
        self._source.close()


class RunPages:
    """The run, or the runs, of one folder.

    Parameters
    ----------
    folder
        Folder of a run, which may not exist yet, or a folder that contains folders of runs.
    config, allow_code
        See `CurveSource`; a config belongs to a single run.
    """

    def __init__(self, folder: Path, config: Path | None, *, allow_code: bool) -> None:
        self._folder = folder.absolute()
        self._config, self._allow_code = config, allow_code
        self._rows: dict[str, RunRow] = {}
        self._runs: dict[str, FollowedRun] = {}
        self._looking = threading.Lock()
        self._asked = -np.inf
        self._end_seen = self._end_drawn = False

    def state(self, run: str) -> dict[str, Any]:
        """Return the state of a run by its name; for "", that of the only run or of all runs.

        Raises
        ------
        RunFolderError
            If there is no such run, or it is damaged.
        """
        self._asked = time.monotonic()
        if not run and self._is_of_runs():
            with self._looking:
                rows = [self._row(name).look() for name in runs_below(self._folder)]
            return {"name": self._folder.name, "runs": rows}
        found = self._run(run).state()
        self._end_seen = not found["goes_on"]
        return found

    def curves(self, run: str, experiment: str) -> dict[str, Any]:
        """Return the curves of an experiment of a run.

        Raises
        ------
        RunFolderError
            If there is no such run, or it is damaged.
        """
        found = self._run(run).curves(experiment)
        self._end_drawn = self._end_seen
        return found

    def stop(self, run: str) -> dict[str, Any]:
        """Stop a run as Ctrl-C does.

        Raises
        ------
        RunFolderError
            If there is no such run, it is not running, or its folder is not writable.
        """
        path = self._run(run).path
        status = str(read_facts(path)["status"])
        if status != RunStatus.RUNNING or left_alone(path, status):
            now = "no longer running" if status == RunStatus.RUNNING else status
            raise RunFolderError(
                f"{path}: only a run in progress can be stopped, but this run is {now}"
            )
        file = path / STOP
        with writing(file, ELSEWHERE):
            file.touch()
        return {"stopped": True}

    def seen_at_the_end(self, seconds: float) -> None:
        """Wait until an open page has read the end of the run, but not longer than `seconds`."""
        begun = time.monotonic()
        while time.monotonic() - begun < seconds:
            if begun - self._asked > SECONDS_OF_INTEREST or self._end_drawn:
                return
            time.sleep(0.05)

    def close(self) -> None:
        """Release the resources of the pages."""
        with self._looking:
            for run in self._runs.values():
                run.close()

    def _is_of_runs(self) -> bool:
        return not (self._folder / "run.json").is_file() and bool(runs_below(self._folder))

    def _row(self, name: str) -> RunRow:
        return self._rows.setdefault(name, RunRow(self._folder / name, name))

    def _run(self, name: str) -> FollowedRun:
        if name and name not in runs_below(self._folder):
            raise RunFolderError(f"{self._folder}: has no run {name!r}")
        with self._looking:
            if name not in self._runs:
                path = self._folder / name if name else self._folder
                config = None if name else self._config
                self._runs[name] = FollowedRun(
                    path, name or path.name, config, allow_code=self._allow_code
                )
            return self._runs[name]


def runs_below(folder: Path) -> list[str]:
    """Return the names of the folders of runs in a folder."""
    return sorted(path.parent.name for path in folder.glob("*/run.json"))
