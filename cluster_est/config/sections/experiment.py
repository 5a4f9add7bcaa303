"""The keys of an experiment, and those that all experiments share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, Strict

from cluster_est.settings import (
    ConfigSection,
    Count,
    Finite,
    Free,
    Known,
    Ordinal,
    Pair,
    Samples,
    as_column,
    as_group,
)


class InputSection(ConfigSection):
    """Keys of an input or signal: its column and interpolation."""

    column: str = Field(description="column of the data")
    interpolation: Literal["linear", "hold"] = Field("linear", description="between samples")


class OutputSection(ConfigSection):
    """Keys of a measured output."""

    column: str = Field(description="column of the data")
    interpolation: Literal["linear", "hold"] = Field(
        "linear", description="between samples, where the time base asks for other times"
    )
    weight: Finite = Field(1.0, gt=0.0, description="of its squares in the cost")
    free_scale: Free = Field(
        False,
        description="known up to a factor: the best one in each experiment is found in closed "
        'form; "shared": one for all experiments, estimated as sensor_OUTPUT.scale',
    )
    free_offset: Free = Field(
        False,
        description="known up to a constant that is added, found likewise; "
        'sensor_OUTPUT.offset where it is "shared"',
    )
    detection_limit: Finite | None = Field(
        None, description="measured values at or below it say no more than that"
    )
    ordinal: Ordinal = Field(
        False,
        description="the values say an order alone, such as grades from 1 to 5; or the words of "
        'the column, the lowest first: ["low", "high"]; sigma is then in spreads of the simulated '
        "signal",
    )


class ColumnSection(ConfigSection):
    """Conversion of a column of the data."""

    factor: Finite = Field(1.0, description="the column is multiplied by it")
    offset: Finite = Field(0.0, description="and this is added, in the new unit")
    demean: bool = Field(False, description="subtract the mean of the used rows first")


class CurveSection(ConfigSection):
    """Keys of a measured curve without times."""

    columns: dict[str, str] = Field(
        min_length=1, description="FMU output = column: points without times, in their order"
    )
    tolerance: dict[str, Annotated[Finite, Field(ge=0.0)]] = Field(
        default_factory=dict,
        description="FMU output = how far any simulated point may lie from the curve; a constraint",
    )
    samples: Samples = Field(
        1000, description="points of the simulated curve, evenly from start to stop"
    )


class _NamedSection(ConfigSection):
    """The key that no two experiments share."""

    id: str = Field(min_length=1, description="name of the experiment, unique")


class _ExperimentKeys(ConfigSection):
    """What an experiment says of its table, or what all of them say."""

    data: str | None = Field(
        None,
        description="path of the table: csv, parquet, feather or mat; without: nothing is measured",
    )
    time: str | None = Field(None, description="column with the time in seconds")
    sample_time: Finite | None = Field(
        None, gt=0.0, description="seconds between rows, where there is no time column"
    )
    rows: Annotated[tuple[Count, Count], Strict(False)] | None = Field(
        None, description="[from, to]: rows from (counted from 0) up to, not with, to"
    )
    missing: list[Finite] = Field(
        default_factory=list,
        description="numbers in the columns that mean that nothing was measured, such as -9999; "
        "they count as empty cells, before a column is converted",
    )
    inputs: dict[str, Annotated[InputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict, description="FMU input = column, or { column, interpolation }"
    )
    outputs: dict[str, Annotated[OutputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict,
        description="FMU output = column, or { column, interpolation, weight, free_scale, "
        "free_offset, detection_limit, ordinal }; empty cells: not measured",
    )
    curve: CurveSection | None = Field(
        None, description="measured points without times, such as force over displacement"
    )
    signals: dict[str, Annotated[InputSection, BeforeValidator(as_column)]] = Field(
        default_factory=dict,
        description="name = column, or { column, interpolation }: measured, but no input of the "
        "FMU; effects may depend on it",
    )
    sigma: dict[str, Annotated[Finite, Field(gt=0.0)]] = Field(
        default_factory=dict, description="FMU output = standard deviation of its noise; default 1"
    )
    relative_sigma: dict[str, Annotated[Finite, Field(ge=0.0)]] = Field(
        default_factory=dict,
        description="FMU output = part of each measured value that its noise has besides sigma: "
        "sqrt(sigma^2 + (relative_sigma value)^2)",
    )
    start: Finite | None = Field(None, description="seconds; default: the first time in the data")
    stop: Finite | None = Field(None, description="seconds; default: the last measured time")
    warm_up: Finite = Field(0.0, ge=0.0, description="seconds from start on that do not count")
    weight: Finite = Field(1.0, gt=0.0, description="of its squares in the cost")
    windows: list[Pair] = Field(
        default_factory=list, description="[[from, to], ...] seconds that count"
    )
    test_windows: list[Pair] = Field(
        default_factory=list,
        description="[[from, to], ...] seconds that are held out: only reported, as an experiment "
        '"ID (held out)"',
    )
    role: Literal["train", "test"] = Field("train", description="test: held out, only reported")
    values: dict[str, Known] = Field(
        default_factory=dict, description="known values of this run, by FMU name"
    )
    group: Annotated[dict[str, str], BeforeValidator(as_group)] = Field(
        default_factory=dict, description='KEY = "label" for parameters that are per "group:KEY"'
    )
    columns: dict[str, ColumnSection] = Field(
        default_factory=dict, description="column = { factor, offset, demean }"
    )


class ExperimentSection(_ExperimentKeys, _NamedSection):
    """Keys of one measured experiment."""


class ExperimentDefaultsSection(_ExperimentKeys):
    """Keys that every experiment has unless it says otherwise."""
