"""Limits of the next experiment: of its inputs, and of other variables."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Self

from pydantic import BeforeValidator, Field, model_validator

from cluster_est.settings import Finite, Pair, Settings, sentence
from cluster_est.toml import dotted
from workers.messages.checks import told_apart

FEWEST_SAMPLES = 10
MOST_SAMPLES = 200_000


def _pair(value: object) -> object:
    """Return a range; one number is short for a range with both ends equal."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return [value, value] if number else value


class InputLimits(Settings):
    """Limits of one input."""

    section: ClassVar[str] = "inputs"

    lower: Finite = Field(description="lower limit of the input, in its unit")
    upper: Finite = Field(description="upper limit of the input, in its unit")
    rate: float = Field(math.inf, gt=0.0, description="largest change per second")
    start: Finite | None = Field(None, description="first value of the input; default: any")
    hold: Finite = Field(
        0.0,
        ge=0.0,
        description=(
            "shortest time in seconds for which a level is held, and shortest half-period of a "
            "wave; 0: four sampling intervals"
        ),
    )


class SignalLimits(Settings):
    """Limits of one output or other variable of the FMU."""

    section: ClassVar[str] = "signals"

    lower: float = Field(
        -math.inf, description="lower limit of the variable, in its unit; default: none"
    )
    upper: float = Field(
        math.inf, description="upper limit of the variable, in its unit; default: none"
    )


class StartLimits(Settings):
    """A start value that may be chosen."""

    section: ClassVar[str] = "start"

    lower: Finite = Field(description="smallest start value, in the unit of the variable")
    upper: Finite = Field(description="largest start value, in the unit of the variable")


class ExperimentLimits(Settings):
    """Limits of the next experiment."""

    section: ClassVar[str] = "limits"

    inputs: dict[str, InputLimits] = Field(
        default_factory=dict, description="inputs to design, by their names in the FMU"
    )
    duration: Annotated[Pair, BeforeValidator(_pair)] = Field(
        description="duration in seconds, or [shortest, longest]"
    )
    sample_time: Finite = Field(
        gt=0.0, description="seconds between two samples of inputs and outputs"
    )
    signals: dict[str, SignalLimits] = Field(
        default_factory=dict,
        description=(
            "outputs and other variables that must stay within limits; default: outputs may leave "
            "their range in the run by at most half of that range"
        ),
    )
    like: str = Field(
        "",
        description=(
            "experiment of the run that has the same initial state and the same measured outputs "
            "as the next experiment; default: the first training experiment"
        ),
    )
    start: dict[str, StartLimits] = Field(
        default_factory=dict,
        description="start values that may be chosen, by their names in the FMU",
    )

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        """Refuse limits that no experiment can satisfy."""
        self._check_times()
        for name, given in self.inputs.items():
            _check_range(given, f"inputs.{name}")
            if given.start is not None and not given.lower <= given.start <= given.upper:
                low, high, start = told_apart(given.lower, given.upper, given.start)
                raise sentence(
                    f"inputs.{name}.start: must lie between lower, {low}, and upper, {high}, but "
                    f"is {start}; change one of the three"
                )
        for name, signal in self.signals.items():
            _check_range(signal, f"signals.{name}")
            if math.isinf(signal.lower) and math.isinf(signal.upper):
                raise sentence(
                    f"signals.{name}: must have lower or upper, but has neither; add one of them"
                )
        if not self.inputs and not self.start:
            raise sentence(
                "inputs: must name at least one input, or start must name at least one start "
                "value, but both are empty; add [inputs.NAME] with lower and upper"
            )
        for name, between in self.start.items():
            _check_range(between, f"start.{name}")
        for name, given in self.inputs.items():
            if given.hold > self.duration[0]:
                most, hold = told_apart(self.duration[0], given.hold)
                raise sentence(
                    f"{dotted('inputs', name)}.hold: must be at most the duration, {most} s, but "
                    f"is {hold} s; change one of the two"
                )
        return self

    def _check_times(self) -> None:
        shortest, longest = self.duration
        if not 0.0 < shortest <= longest:
            raise sentence(
                "duration: must be a positive number of seconds, or [shortest, longest] with "
                f"0 < shortest <= longest, but is {list(self.duration)}; change it"
            )
        if shortest / self.sample_time < FEWEST_SAMPLES:
            raise sentence(
                f"sample_time: must give at least {FEWEST_SAMPLES} samples in a duration of "
                f"{shortest:g} s, but is {self.sample_time:g} s; change one of the two"
            )
        if longest / self.sample_time > MOST_SAMPLES:
            raise sentence(
                f"sample_time: must give at most {MOST_SAMPLES:,} samples in a duration of "
                f"{longest:g} s, but is {self.sample_time:g} s; change one of the two"
            )


def _check_range(given: InputLimits | SignalLimits | StartLimits, where: str) -> None:
    if not given.lower < given.upper:
        low, high = told_apart(given.lower, given.upper)
        raise sentence(
            f"{where}.lower: must be below upper, {high}, but is {low}; change one of the two"
        )
