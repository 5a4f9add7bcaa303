"""What a config names on disk: finds the files, and makes an experiment's rows signals."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cluster_est.config.reader import ExperimentSection, InputSection
from cluster_est.errors import ConfigError, DataError
from cluster_est.problem.data import MeasuredTable
from workers.fmu.description import nearest
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
    """Columns of one experiment: the rows that it uses, scaled as it says.

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
        self._table, self._section, self._where = table, section, where
        self._first = section.rows[0] if section.rows else 0
        for name in section.columns:
            if name not in table.columns:
                raise DataError(
                    f"{where}.columns: {table.path} has no column {name!r}"
                    f"{nearest(name, table.columns)}"
                )

    def times(self) -> FloatArray:
        """The time of each used row."""
        section, path = self._section, self._table.path
        if section.time is not None:
            times = self._column(section.time)
            source = f"{path}, column {section.time!r}"
        else:
            column = self._first_column()
            with np.errstate(over="ignore"):
                rows = np.arange(len(self._column(column)), dtype=np.float64)
                times = rows * (section.sample_time or 1.0)
            source = f"sample_time = {section.sample_time}"
        if len(times) < 2:
            raise DataError(
                f"{self._where}: must use at least two rows of {path} but uses {len(times)}; "
                + ("check rows" if section.rows else "it needs measurements below its header")
            )
        check_times(times, f"{self._where}: {source}", self._row)
        return times

    def input(self, times: FloatArray, variable: str) -> Input:
        """A signal that drives the model, without the rows where it was not measured."""
        return self._driving(times, variable, self._section.inputs[variable], "inputs")

    def signal(self, times: FloatArray, name: str) -> Input:
        """A measured signal that only effects depend on, likewise."""
        return self._driving(times, name, self._section.signals[name], "signals")

    def output(self, times: FloatArray, variable: str) -> Output:
        """A signal that the model should follow, where it was measured."""
        given = self._section.outputs[variable]
        values = self._values(times, given.column, f"outputs.{variable}")
        measured = np.isfinite(values)
        sigma = self._section.sigma.get(variable, 1.0)
        return Output(variable, times[measured], values[measured], sigma)

    def points(self, columns: dict[str, str]) -> FloatArray:
        """(n, d): the points of a curve, without those of which a part was not measured.

        Raises
        ------
        DataError
            If there are fewer than two.
        """
        found = [self._column(name) for name in columns.values()]
        lengths = {len(values) for values in found}
        if len(lengths) > 1:
            raise DataError(
                f"{self._where}.curve: the columns must have as many rows as each other but have "
                f"{' and '.join(str(n) for n in sorted(lengths))}; choose others"
            )
        points = np.column_stack(found)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < 2:
            raise DataError(
                f"{self._where}.curve: must have at least two points but has {len(points)} in "
                f"{self._table.path}; check the columns and rows"
            )
        return np.ascontiguousarray(points)

    def _first_column(self) -> str:
        section = self._section
        for given in (section.outputs, section.inputs, section.signals):
            for each in given.values():
                return each.column
        raise AssertionError("a config without columns has been refused")

    def _driving(self, times: FloatArray, name: str, given: InputSection, key: str) -> Input:
        values = self._values(times, given.column, f"{key}.{name}")
        known = np.isfinite(values)
        return Input(name, times[known], values[known], given.interpolation)

    def _values(self, times: FloatArray, name: str, key: str) -> FloatArray:
        values = self._column(name)
        column = f"column {name!r} of {self._table.path}"
        if len(values) != len(times):
            raise DataError(
                f"{self._where}.{key}: {column} must have as many rows as the time, {len(times)}, "
                f"but has {len(values)}; choose another or mend it"
            )
        if np.isnan(values).all():
            raise DataError(
                f"{self._where}.{key}: {column} must hold at least one number but is empty in "
                f"these rows; choose another column or remove {key}"
            )
        infinite = np.flatnonzero(np.isinf(values))
        if len(infinite):
            raise DataError(
                f"{self._where}: {self._table.path}, column {name!r}, "
                f"row {self._row(int(infinite[0]))}: must be a finite number but is "
                f"{values[infinite[0]]}; mend it, or leave it empty where nothing was measured"
            )
        return values

    def _row(self, used: int) -> int:
        """The row in the file of one of the used rows."""
        return self._table.row(self._first + used)

    def _column(self, name: str) -> FloatArray:
        values = self._table.numbers(name, self._where)
        if self._section.rows is not None:
            first, last = self._section.rows
            if last > len(values):
                raise ConfigError(
                    f"{self._where}.rows: must lie within the {len(values)} rows of "
                    f"{self._table.path} but is [{first}, {last}]; lower its end"
                )
            values = values[first:last]
        change = self._section.columns.get(name)
        if change is None:
            return values
        known = np.isfinite(values)
        with np.errstate(over="ignore", invalid="ignore"):
            mean = float(np.mean(values[known])) if change.demean and known.any() else 0.0
            return (values - mean) * change.factor + change.offset


def check_times(times: FloatArray, where: str, row: Callable[[int], int]) -> None:
    """Refuse times that are not finite and strictly increasing, naming the first bad row.

    Parameters
    ----------
    times
        In seconds.
    where
        Opens the message.
    row
        The row of the file that an index stands for.

    Raises
    ------
    DataError
        If there is a bad row.
    """
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise DataError(
            f"{where}, row {row(int(bad[0]))}: the time must be a finite number but is "
            f"{times[bad[0]]}; remove the row or mend it"
        )
    back = np.flatnonzero(times[1:] <= times[:-1])
    if len(back):
        i = int(back[0]) + 1
        how = "repeats" if times[i] == times[i - 1] else "goes back from"
        raise DataError(
            f"{where}, row {row(i)}: times must increase but {times[i]:.9g} {how} "
            f"{times[i - 1]:.9g} of the row before; sort the rows and remove repeated ones"
        )
