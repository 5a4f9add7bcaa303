"""A file of limits for the next experiment, read and checked."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field, ValidationError

from cluster_est.errors import ConfigError, ProblemError
from cluster_est.experiment_design.candidate_inputs import RECORDED
from cluster_est.experiment_design.criteria import CRITERIA
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.request import DesignSettings
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.problem.tables.files import read_table
from cluster_est.settings import LARGEST, ConfigSection, Count, Finite, Pair, error_messages, one_of
from workers.messages import Experiment, Input, Interpolation
from workers.messages.checks import as_path


def _pair(value: object) -> object:
    """One number is short for a range of that number alone."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return [value, value] if number else value


class InputLimitsSection(ConfigSection):
    """Limits of one input."""

    lower: Finite = Field(description="in the input's unit")
    upper: Finite = Field(description="in the input's unit")
    rate: float = Field(math.inf, gt=0.0, description="largest change in a second")
    start: Finite | None = Field(None, description="value that it begins at; default: any")
    hold: Finite = Field(
        0.0,
        ge=0.0,
        description="seconds for which a level is held at least, and the shortest half period of "
        "a wave; 0: four samples",
    )


class SignalLimitsSection(ConfigSection):
    """Limits of one output or other variable of the FMU."""

    lower: float = Field(-math.inf, description="in the variable's unit; default: none")
    upper: float = Field(math.inf, description="in the variable's unit; default: none")


class StartLimitsSection(ConfigSection):
    """A start value that may be chosen."""

    lower: Finite = Field(description="in the variable's unit")
    upper: Finite = Field(description="in the variable's unit")


class PredictionSection(ConfigSection):
    """What is to be predicted: an experiment of the run, or one that is planned."""

    experiment: str = Field("", description="of the run, a test one too; default: all of them")
    data: str = Field(
        "",
        description="instead: table of the inputs of a planned experiment, from the folder of this "
        "file; what it does not have is that of the experiment like",
    )
    time: str = Field("time", description="its column of times, in seconds")
    inputs: dict[str, str] = Field(
        default_factory=dict,
        description="FMU input = its column; default: all columns, named as inputs",
    )
    interpolation: Interpolation = Field("linear", description="or hold: between its samples")
    outputs: list[str] = Field(
        default_factory=list,
        description="the FMU's names; default: those that are measured in it, for a planned one "
        "those that the run measures",
    )


class LimitsSections(ConfigSection):
    """A whole file of limits."""

    duration: Annotated[Pair, BeforeValidator(_pair)] = Field(
        description="seconds, or [shortest, longest]"
    )
    sample_time: Finite = Field(
        gt=0.0, description="seconds between two samples of inputs and outputs"
    )
    like: str = Field(
        "",
        description="experiment of the run that the next one begins like, and whose outputs are "
        "measured; default: the first training experiment",
    )
    criterion: str = Field(
        "",
        description=f"{one_of(CRITERIA)}: tell the rivals of a finding apart, narrow parameters "
        "together (d) or each (a), or narrow predictions (v); default: v where there are "
        "predictions, discriminate where there are rivals, else d",
    )
    parameters: list[str] = Field(
        default_factory=list,
        description="names of the parameters that are narrowed; default: all that experiments "
        "share",
    )
    predictions: list[PredictionSection] = Field(
        default_factory=list,
        description="what is predicted, for v; default: all outputs of all experiments of the run",
    )
    rivals: list[str] = Field(
        default_factory=list,
        description="names of the models that are told apart, as show prints them; default: all "
        "that the run kept",
    )
    waveforms: list[str] = Field(
        default_factory=list,
        description=f"families of inputs: {one_of([*WAVEFORMS, RECORDED])}; default: all",
    )
    candidates: int = Field(120, ge=10, le=LARGEST, description="inputs that are looked at")
    seed: Count = Field(0, description="of the random generator")
    inputs: dict[str, InputLimitsSection] = Field(
        default_factory=dict, description="inputs that are designed, by the FMU's names"
    )
    signals: dict[str, SignalLimitsSection] = Field(
        default_factory=dict,
        description="outputs and other variables that must stay within limits; default: outputs "
        "leave what the run has seen by half of its range at most",
    )
    start: dict[str, StartLimitsSection] = Field(
        default_factory=dict, description="start values that may be chosen, by the FMU's names"
    )


OPTION = "--predict"


def prediction_targets(
    sections: Sequence[PredictionSection], base: Path
) -> tuple[PredictionTarget, ...]:
    """Return the targets of a file of limits.

    Parameters
    ----------
    sections
        Of the file.
    base
        Its folder, from which paths of tables start.

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
    """The name of an experiment of the run, or one that is planned."""
    if not section.data:
        for key in ("inputs", "time", "interpolation"):
            if key in section.model_fields_set:
                raise ConfigError(
                    f"{where}.{key}: must stand beside data, the table of a planned experiment, "
                    "but there is none; add data or remove it"
                )
        return section.experiment
    if section.experiment:
        raise ConfigError(
            f"{where}.data: must be left out where an experiment of the run is named, but is "
            f"{section.data!r}; remove one of the two"
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
            f"{where}.data: {section.data} must have a column for an input, and two rows at least, "
            f"but has {len(columns)} and {len(times)}"
        )
    name = Path(section.data).stem
    return Experiment(name, float(times[0]), float(times[-1]), inputs, ())


def with_named_targets(
    settings: DesignSettings, named: Sequence[str], experiments: Collection[str]
) -> DesignSettings:
    """Return settings that narrow what the command line names, in the place of the file's.

    Parameters
    ----------
    settings
        Of the file of limits.
    named
        "EXPERIMENT" or "EXPERIMENT:OUTPUT,OUTPUT".
    experiments
        Names of the run's.

    Raises
    ------
    ConfigError
        If the file asks for another criterion.
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
        return replace(settings, predictions=tuple(targets))
    except ProblemError as error:
        raise ConfigError(f"{OPTION}: {error}") from None


@dataclass(frozen=True)
class LimitsFile:
    """The contents of a file of limits.

    Attributes
    ----------
    limits, settings, seed
        Of the experiment, and what it is chosen for.
    text
        Of the file.
    """

    limits: ExperimentLimits
    settings: DesignSettings
    seed: int
    text: str


def read_limits(path: str | Path) -> LimitsFile:
    """Read and check a file of limits.

    Raises
    ------
    ConfigError
        If there is no such file, it is not TOML, or something in it is wrong.
    """
    path = as_path(path, "--limits", ConfigError)
    try:
        text = path.read_text(encoding="utf-8-sig")
        raw = tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"--limits: there is no file {path}; check the path") from None
    except OSError as error:
        raise ConfigError(
            f"--limits: {path} must be a file that can be read but cannot be ({error.strerror}); "
            "check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: must be TOML but is not: {error}; mend that line") from None
    try:
        found = LimitsSections.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(
            "\n".join(error_messages(error, str(path), raw, LimitsSections))
        ) from None
    try:
        return _built(found, text, path.parent)
    except ProblemError as error:
        raise ConfigError(f"{path}: {error}") from None


def _built(found: LimitsSections, text: str, base: Path) -> LimitsFile:
    limits = ExperimentLimits(
        inputs={name: InputLimits(**each.model_dump()) for name, each in found.inputs.items()},
        duration=found.duration,
        sample_time=found.sample_time,
        signals={name: SignalLimits(**each.model_dump()) for name, each in found.signals.items()},
        like=found.like,
        start={name: SignalLimits(**each.model_dump()) for name, each in found.start.items()},
    )
    settings = DesignSettings(
        criterion=found.criterion,
        parameters=tuple(found.parameters),
        rivals=tuple(found.rivals),
        waveforms=tuple(found.waveforms),
        candidates=found.candidates,
        predictions=prediction_targets(found.predictions, base),
    )
    return LimitsFile(limits, settings, found.seed, text)
