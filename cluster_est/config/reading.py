"""The files that a config names, and the columns of an experiment."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from cluster_est.config.reader import ExperimentSection, InputSection
from cluster_est.errors import ConfigError
from cluster_est.problem.tables.files import MeasuredTable
from cluster_est.problem.tables.measured import ColumnChange, MeasuredColumns, with_grades
from workers.messages import FloatArray, Input, Output


def find_file(name: str, base: Path, folders: list[str], where: str) -> Path:
    """Look for a file beside the config, then in the data folders.

    Raises
    ------
    ConfigError
        If it is in none of them; the message lists them all.
    """
    tried = []
    for folder in [".", *folders]:
        beside, file = os.path.expandvars(folder), os.path.expandvars(name)
        if "$" in beside + file:
            tried.append(f"{os.path.join(beside, file)} (which is not set)")
            continue
        try:
            candidate = base / Path(beside).expanduser() / Path(file).expanduser()
            if candidate.is_file():
                return candidate
            shown = os.path.normpath(candidate)
            tried.append(f"{shown} (a folder)" if candidate.is_dir() else shown)
        except (OSError, RuntimeError) as error:  # too long, not permitted, ~ of nobody
            tried.append(f"{file} ({error})")
    raise ConfigError(
        f"{where}: there is no file {name!r}; looked for {', '.join(dict.fromkeys(tried))}; "
        "check the name, or add its folder to data_folders"
    )


class ExperimentReader:
    """Columns of one experiment, as its section in the config says.

    Parameters
    ----------
    table
        The measured file.
    section
        What the config says about the experiment.
    where
        Opens each message.
    """

    def __init__(self, table: MeasuredTable, section: ExperimentSection, where: str) -> None:
        changes = {
            name: ColumnChange(each.factor, each.offset, each.demean)
            for name, each in section.columns.items()
        }
        missing = tuple(section.missing)
        self._columns = MeasuredColumns(table, where, section.rows, changes, missing)
        self._section = section

    def times(self) -> FloatArray:
        """The time of each used row."""
        section = self._section
        return self._columns.times(section.time, section.sample_time, self._first_column())

    def input(self, times: FloatArray, variable: str) -> Input:
        """A signal that drives the model, without the rows where it was not measured."""
        return self._driving(times, variable, self._section.inputs[variable], "inputs")

    def signal(self, times: FloatArray, name: str) -> Input:
        """A measured signal that only effects depend on, likewise."""
        return self._driving(times, name, self._section.signals[name], "signals")

    def output(self, times: FloatArray, variable: str) -> Output:
        """A signal that the model should follow, where it was measured."""
        column = self._section.outputs[variable].column
        sigma = self._section.sigma.get(variable, 1.0)
        relative = self._section.relative_sigma.get(variable, 0.0)
        how = self._section.outputs[variable]
        columns = self._columns
        if isinstance(how.ordinal, list):
            columns = with_grades(columns, variable, column, how.ordinal)
        output = columns.output(times, variable, column, sigma, relative)
        return replace(
            output,
            free_scale=how.free_scale is True,  # shared ones are effects
            free_offset=how.free_offset is True,
            detection_limit=how.detection_limit,
            ordinal=how.ordinal is not False,
        )

    def points(self, columns: dict[str, str]) -> FloatArray:
        """(n, d): the points of a curve, without those of which a part was not measured."""
        return self._columns.points(columns.values())

    def _driving(self, times: FloatArray, name: str, given: InputSection, key: str) -> Input:
        return self._columns.driving(times, name, given.column, given.interpolation, key)

    def _first_column(self) -> str:
        section = self._section
        for given in (section.outputs, section.inputs, section.signals):
            for each in given.values():
                return each.column
        raise AssertionError("a config without columns has been refused")
