"""Reading and checking of a limits file for the next experiment."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from cluster_est.config.config_text import read_toml
from cluster_est.errors import ConfigError, ProblemError
from cluster_est.experiment_design.limits import ExperimentLimits
from cluster_est.experiment_design.request import DesignSettings
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.problem.tables.files import read_table
from cluster_est.settings import (
    ConfigSection,
    Count,
    checked,
)
from workers.messages import Experiment, Input, Interpolation
from workers.messages.checks import as_path


class PredictionSection(ConfigSection):
    """What is to be predicted: an experiment of the run, or one that is planned."""

    experiment: str = Field(
        "", description="an experiment of the run, training or test; default: all of them"
    )
    data: str = Field(
        "",
        description="instead of experiment: table with the inputs of a planned experiment; its "
        "path is relative to the folder of this file; everything that the table lacks "
        'is taken from the experiment of the key "like"',
    )
    time: str = Field("time", description="column with the times of the table, in seconds")
    inputs: dict[str, str] = Field(
        default_factory=dict,
        description="FMU input = column; default: all columns, whose names must then be names of "
        "inputs",
    )
    interpolation: Interpolation = Field(
        "linear", description="interpolation of the inputs between samples: linear or hold"
    )
    outputs: list[str] = Field(
        default_factory=list,
        description="names of outputs in the FMU; default: the measured outputs of the experiment, "
        "or of the run if the experiment is planned",
    )


class LimitsSections(DesignSettings, ExperimentLimits):
    """A whole file of limits."""

    predictions: list[PredictionSection] = Field(  # type: ignore[assignment]
        default_factory=list, description=DesignSettings.model_fields["predictions"].description
    )
    seed: Count = Field(0, description="seed of the random generator")


OPTION = "--predict"


def prediction_targets(
    sections: Sequence[PredictionSection], base: Path
) -> tuple[PredictionTarget, ...]:
    """Return the targets of a limits file.

    Parameters
    ----------
    sections
        Sections of the file.
    base
        Folder of the file, to which paths of tables are relative.

    Raises
    ------
    ClusterEstError
        If a section names both an experiment and a table, or a table cannot be read.
    """
    return tuple(
        PredictionTarget(_experiment(each, f"predictions[{i}]", base), tuple(each.outputs))
        for i, each in enumerate(sections)
    )


def _experiment(section: PredictionSection, where: str, base: Path) -> str | Experiment:
    """Return the name of an experiment of the run, or a planned experiment."""
    if not section.data:
        for key in ("inputs", "time", "interpolation"):
            if key in section.model_fields_set:
                raise ConfigError(
                    f"{where}.{key}: is only for a planned experiment, which needs a table under "
                    f'the key "data"; add data, or remove {key}'
                )
        return section.experiment
    if section.experiment:
        raise ConfigError(
            f"{where}.data: must not be used with experiment, but is {section.data!r}; remove data "
            "or experiment"
        )
    table = read_table(base / section.data, f"{where}.data")
    times = table.numbers(section.time, f"{where}.time")
    columns = section.inputs or {name: name for name in table.columns if name != section.time}
    inputs = tuple(
        Input(name, times, table.numbers(column, f"{where}.inputs.{name}"), section.interpolation)
        for name, column in columns.items()
    )
    if not inputs or len(times) < 2:
        raise ConfigError(
            f"{where}.data: {section.data} must have at least one column for an input and at least "
            f"two rows, but has {len(columns)} such columns and {len(times)} rows"
        )
    name = Path(section.data).stem
    return Experiment(name, float(times[0]), float(times[-1]), inputs, ())


def with_named_targets(
    settings: DesignSettings, named: Sequence[str], experiments: Collection[str]
) -> DesignSettings:
    """Return settings with the targets of the command line instead of those of the file.

    Parameters
    ----------
    settings
        Settings of the limits file.
    named
        "EXPERIMENT" or "EXPERIMENT:OUTPUT,OUTPUT".
    experiments
        Names of the experiments of the run.

    Raises
    ------
    ConfigError
        If the file selects another criterion.
    """
    if not named:
        return settings
    targets = []
    for text in named:
        name, outputs = text, ""
        if text not in experiments and ":" in text:
            name, _, outputs = text.rpartition(":")
        targets.append(
            PredictionTarget(name, tuple(o.strip() for o in outputs.split(",") if o.strip()))
        )
    try:
        return settings.changed(predictions=tuple(targets))
    except ProblemError as error:
        raise ConfigError(f"{OPTION}: {error}") from None


@dataclass(frozen=True)
class LimitsFile:
    """The contents of a limits file.

    Attributes
    ----------
    limits, settings, seed
        Limits of the experiment, and settings of the design.
    text
        Text of the file.
    """

    limits: ExperimentLimits
    settings: DesignSettings
    seed: int
    text: str


def read_limits(path: str | Path) -> LimitsFile:
    """Read and check a limits file.

    Raises
    ------
    ConfigError
        If there is no such file, it is not TOML, or something in it is wrong.
    """
    path = as_path(path, "--limits", ConfigError)
    text, raw = read_toml(path, "--limits: there is no file")
    found = checked(LimitsSections, raw, str(path))
    try:
        targets = prediction_targets(found.predictions, path.parent)
        limits = {name: getattr(found, name) for name in ExperimentLimits.model_fields}
        settings = {name: getattr(found, name) for name in DesignSettings.model_fields}
        return LimitsFile(
            ExperimentLimits(**limits),
            DesignSettings(**settings | {"predictions": targets}),
            found.seed,
            text,
        )
    except ProblemError as error:
        raise ConfigError(f"{path}: {error}") from None
