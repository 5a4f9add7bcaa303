"""The keys of an experiment, and the defaults for all experiments.

The keys of `[experiment_defaults]` apply to every experiment that does not set them itself. They
are inserted into the experiments of the raw tree before the complete tree is checked. So no other
module handles defaults, and the config saved by a run contains all keys of every experiment.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict

from cluster_est.settings import (
    ConfigSection,
    Count,
    Finite,
    Free,
    KnownValue,
    Ordinal,
    Pair,
    Samples,
    as_column,
    as_group,
)
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import GapRule, Interpolation


class InputSection(ConfigSection):
    """Keys of an input or signal: its column and interpolation."""

    column: str = Field(description="column of the data; * stands for any text in its name")
    interpolation: Interpolation = Field("linear", description="between samples")
    time: str = Field(
        "",
        description="column with the times of this signal, if they differ from those of the other "
        "columns",
    )


class OutputSection(ConfigSection):
    """Keys of a measured output."""

    column: str = Field(description="column of the data; * stands for any text in its name")
    interpolation: Interpolation = Field(
        "linear",
        description="interpolation between the measured samples, if cost.time_base asks for other "
        "times",
    )
    time: str = Field(
        "",
        description="column with the times of this output, if they differ from those of the other "
        "columns",
    )
    weight: Finite = Field(1.0, gt=0.0, description="weight of its squared residuals in the cost")
    free_scale: Free = Field(
        False,
        description="true: the output is known up to a factor, which is computed in closed form "
        'for each experiment; "shared": one factor for all experiments, estimated as '
        "sensor_OUTPUT.scale",
    )
    free_offset: Free = Field(
        False,
        description="true: the output is known up to an added constant, which is computed for each "
        'experiment; "shared": one constant for all experiments, estimated as '
        "sensor_OUTPUT.offset",
    )
    detection_limit: Finite | None = Field(
        None, description="measured values at or below this limit count as not detected"
    )
    ordinal: Ordinal = Field(
        False,
        description="true: only the order of the values counts, as for grades from 1 to 5; for "
        'words, a list of them, the lowest first: ["low", "high"]; sigma is then given '
        "in standard deviations of the simulated signal",
    )


class ColumnSection(ConfigSection):
    """Conversion of a column of the data."""

    factor: Finite = Field(1.0, description="factor by which the column is multiplied")
    offset: Finite = Field(
        0.0, description="offset added after the multiplication, in the new unit"
    )
    demean: bool = Field(False, description="true: first subtract the mean of the used rows")
    late: Finite = Field(
        0.0, description="delay of the column in seconds, which is subtracted from its times"
    )


class CurveSection(ConfigSection):
    """Keys of a measured curve without times."""

    columns: dict[str, str] = Field(
        min_length=1,
        description="FMU output = column with the points of the curve, in the order in which it "
        "passes them",
    )
    tolerance: dict[str, Annotated[Finite, Field(ge=0.0)]] = Field(
        default_factory=dict,
        description="FMU output = largest distance of a simulated point from the measured curve in "
        "this column; a constraint",
    )
    samples: Samples = Field(
        1000,
        description="number of points of the simulated curve, evenly spaced in time from start to "
        "stop",
    )


class LongSection(ConfigSection):
    """Keys of a table with a row for each value."""

    names: str = Field(description="column with the name of the signal")
    values: str = Field(description="column with the values")


class _NamedSection(ConfigSection):
    """The key that is unique to each experiment."""

    id: str = Field(
        min_length=1,
        description="unique name of the experiment; if the entry stands for several files or "
        "tests, * is replaced by the name of each",
    )


class _ExperimentKeys(ConfigSection):
    """Keys that may be set for an experiment or as defaults for all experiments."""

    data: str | Annotated[list[str], Field(min_length=1)] | None = Field(
        None,
        description="path of the table: csv, parquet, feather or mat; with cluster-est[files] also "
        "HDF5, MDF, TDMS or xlsx; with a * in the name, each matching file is one "
        "experiment; a list of paths: the files of one test, each with its own times in the "
        "column time; default: nothing is measured",
    )
    encoding: str = Field(
        "",
        description='encoding of a text file, such as "cp1252"; default: UTF-8, or a guess, which '
        "is reported",
    )
    skip_rows: Count | None = Field(
        None,
        description="number of lines above the header of a text file or sheet; default: detected",
    )
    decimal: Literal["", ".", ","] = Field(
        "",
        description='decimal separator, "," or "."; the other sign separates thousands; default: '
        "detected",
    )
    sheet: str = Field(
        "",
        description="name of a sheet of the workbook, or of an experiment in the FMU, if there are "
        "several",
    )
    long: LongSection | None = Field(
        None, description="{ names, values }: for a table that has one row for each value"
    )
    split_by: str | None = Field(
        None,
        description="column that names the test to which a row belongs; each test becomes one "
        "experiment",
    )
    split_value: str | None = Field(
        None, description="with split_by: the value of that column for the test to use"
    )
    time: str | None = Field(
        None,
        description="column with the time, in seconds or as timestamps; timestamps are counted "
        'from the first used row; "DATE + CLOCK" joins two columns',
    )
    time_format: str = Field(
        "", description='format of times as text, such as "%d/%m/%Y %H:%M:%S"; default: detected'
    )
    time_zone: str = Field(
        "",
        description='time zone of timestamps that do not name one, such as "Europe/Berlin"; needed '
        "if clocks may have been changed for summer time",
    )
    sample_time: Finite | None = Field(
        None, gt=0.0, description="seconds between rows, if there is no time column"
    )
    rows: Annotated[tuple[Count, Count], Strict(False)] | None = Field(
        None,
        description='[from, to]: rows from "from" (counted from 0) up to, but not including, "to"',
    )
    missing: list[Finite] = Field(
        default_factory=list,
        description="numbers that stand for missing values, such as -9999; cells with such a "
        "number count as empty, and the numbers are those before any conversion of the "
        "column",
    )
    inputs: dict[str, Annotated[InputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict, description="FMU input = column, or { column, interpolation }"
    )
    outputs: dict[str, Annotated[OutputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict,
        description="FMU output = column, or { column, interpolation, weight, free_scale, "
        "free_offset, detection_limit, ordinal }; an empty cell means that nothing was "
        "measured",
    )
    curve: CurveSection | None = Field(
        None, description="measured points without times, such as force over displacement"
    )
    signals: dict[str, Annotated[InputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict,
        description="name = column, or { column, interpolation }: a measured signal that is not an "
        "input of the FMU; effects may depend on it",
    )
    sigma: dict[str, Annotated[Finite, Field(gt=0.0)]] = Field(
        default_factory=dict,
        description="FMU output = standard deviation of its noise, in its unit; default: 1",
    )
    relative_sigma: dict[str, Annotated[Finite, Field(ge=0.0)]] = Field(
        default_factory=dict,
        description="FMU output = standard deviation of its noise relative to the measured value, "
        "in addition to sigma; the total is sqrt(sigma^2 + (relative_sigma value)^2)",
    )
    sigma_known: bool = Field(
        True,
        description="false: sigma is a guess, which only weights the outputs; residuals are then "
        "compared with the noise estimated from the data, not with sigma",
    )
    left_out: dict[str, list[Finite]] = Field(
        default_factory=dict,
        description="FMU output = times in seconds of samples to leave out, such as outliers; "
        "close-loop reports which samples it left out",
    )
    start: Finite | None = Field(
        None, description="start of the simulation in seconds; default: the first time in the data"
    )
    stop: Finite | None = Field(
        None, description="end of the simulation in seconds; default: the last measured time"
    )
    warm_up: Finite = Field(
        0.0,
        ge=0.0,
        description="time in seconds after start during which measurements do not count",
    )
    weight: Finite = Field(1.0, gt=0.0, description="weight of its squared residuals in the cost")
    windows: list[Pair] = Field(
        default_factory=list,
        description="[[from, to], ...]: only measurements in these intervals, in seconds, count",
    )
    test_windows: list[Pair] = Field(
        default_factory=list,
        description="[[from, to], ...]: measurements in these intervals, in seconds, are held "
        'out, and reported as an experiment "ID (held out)"',
    )
    role: Literal["train", "test"] = Field(
        "train",
        description="test: the experiment is held out; its errors are reported, but no "
        "shared value is fitted to it",
    )
    gaps: GapRule = Field(
        "split",
        description="what to do at gaps in rows or cells; split: after a gap in which inputs may "
        "have changed, a new part begins, with estimated initial states; bridge: "
        "inputs are interpolated across the gap",
    )
    values: dict[str, KnownValue] = Field(
        default_factory=dict, description="known values of this experiment, by FMU name"
    )
    group: Annotated[dict[str, str], BeforeValidator(as_group)] = Field(
        default_factory=dict, description='KEY = "label", for parameters with per = "group:KEY"'
    )
    columns: dict[str, ColumnSection] = Field(
        default_factory=dict,
        description="column = { factor, offset, demean, late }: how the column is converted before "
        "use",
    )


class ExperimentSection(_ExperimentKeys, _NamedSection):
    """Keys of one measured experiment."""


class ExperimentDefaultsSection(_ExperimentKeys):
    """Keys of every experiment that does not set them itself."""


DEFAULTS = "experiment_defaults"
SIGNAL_TABLES = ("inputs", "outputs", "signals")
"""Tables whose entries are columns; an empty column name removes an entry of the defaults."""
SIGMAS = ("sigma", "relative_sigma")
"""Keys of an experiment with a number for each output."""
EXCLUSIVE_TIME_KEYS = ("time", "sample_time")
"""Mutually exclusive keys: an experiment that sets one does not use the default of the other."""


def with_defaults(raw: dict[str, Any]) -> dict[str, Any]:
    """Return a config's tree without defaults, in which each experiment includes them.

    Parameters
    ----------
    raw
        The tree, as read from TOML, with a valid table of defaults. Its experiments are checked
        later.
    """
    kept = {key: value for key, value in raw.items() if key != DEFAULTS}
    experiments = raw.get("experiments")
    if isinstance(experiments, list):
        defaults = _long_forms(raw[DEFAULTS])
        kept["experiments"] = [
            _whole(defaults, _long_forms(own)) if isinstance(own, dict) else own
            for own in experiments
        ]
    return kept


def unused_defaults(
    defaults: dict[str, Any], experiments: Sequence[ExperimentSection]
) -> Iterator[str]:
    """Yield a sentence for each name in the defaults that no experiment uses."""
    outputs = sorted({name for each in experiments for name in each.outputs})
    columns = sorted({name for each in experiments for name in _used(each.model_dump())})
    for key in SIGMAS:
        for name in defaults.get(key, {}):
            if name not in outputs:
                must = "must be an output of at least one experiment, but is not"
                yield f"{DEFAULTS}.{key}.{name}: {must}{_beside(name, outputs)}"
    for name in defaults.get("columns", {}):
        if name not in columns:
            must = "must be a column that at least one experiment uses, but is not"
            yield f"{DEFAULTS}.{dotted('columns', name)}: {must}{_beside(name, columns)}"


def _beside(name: str, known: list[str]) -> str:
    """Return the end of a message that one of two similar names may be wrong."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"; the nearest name is {near[0]!r}, so one of the two names may be wrong"
    return nearest(name, known)


def _long_forms(section: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of an experiment with short forms replaced by tables."""
    found = dict(section)
    for key in SIGNAL_TABLES:
        if isinstance(found.get(key), dict):
            found[key] = {
                name: {"column": each} if isinstance(each, str) else each
                for name, each in found[key].items()
            }
    if isinstance(found.get("group"), str):
        found["group"] = {"": found["group"]}
    return found


def _whole(defaults: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return an experiment together with its defaults."""
    timed = any(key in own for key in EXCLUSIVE_TIME_KEYS)
    taken = {k: v for k, v in defaults.items() if not (timed and k in EXCLUSIVE_TIME_KEYS)}
    for key in SIGNAL_TABLES:
        gone = {name for name, each in _table(own, key).items() if each == {"column": ""}}
        gone &= set(_table(taken, key))
        if gone:
            taken[key] = {name: each for name, each in taken[key].items() if name not in gone}
            own = own | {key: {name: v for name, v in own[key].items() if name not in gone}}
    whole: dict[str, Any] = _joined(taken, own)
    of_outputs = set(_table(whole, "outputs"))
    for key, known in (*((key, of_outputs) for key in SIGMAS), ("columns", _used(whole))):
        if key in taken and isinstance(whole[key], dict):
            kept = {*known, *_table(own, key)}
            whole[key] = {name: each for name, each in whole[key].items() if name in kept}
    return whole


def _joined(default: Any, own: Any) -> Any:
    """Return tables merged recursively; for other values, that of the experiment."""
    if not isinstance(default, dict) or not isinstance(own, dict):
        return own
    both = {name: _joined(default[name], own[name]) for name in own if name in default}
    return default | own | both


def _table(section: dict[str, Any], key: str) -> dict[str, Any]:
    found = section.get(key)
    return found if isinstance(found, dict) else {}


def _used(experiment: dict[str, Any]) -> set[str]:
    """Return the columns that an experiment uses."""
    named = [experiment.get("time")]
    for key in SIGNAL_TABLES:
        named += [_table({"": each}, "").get("column") for each in _table(experiment, key).values()]
    named += _table(_table(experiment, "curve"), "columns").values()
    return {name for name in named if isinstance(name, str)}
