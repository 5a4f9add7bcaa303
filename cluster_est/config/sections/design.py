"""The keys of a file of limits: what the next experiment may be, and what it is chosen for."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BeforeValidator, Field

from cluster_est.experiment_design.candidates import RECORDED
from cluster_est.experiment_design.criteria import CRITERIA
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.settings import LARGEST, ConfigSection, Count, Finite, Pair, one_of
from workers.messages import Interpolation


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
