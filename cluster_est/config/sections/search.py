"""The keys of what is searched for, and how: cost, constraints, method, starts, uncertainty."""

from __future__ import annotations

import sys
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict
from pydantic_core import PydanticCustomError

from cluster_est.costs import COSTS
from cluster_est.problem.effects.table_values import Monotone
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.settings import ConfigSection, Count, Finite, Pair, Samples, one_of
from cluster_est.shooting.settings import Shooting


def _level(value: Any) -> Any:
    """A number, or points of a curve over time."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and abs(value) <= sys.float_info.max:
        return [(0.0, float(value))]
    if isinstance(value, list) and value and all(isinstance(v, list | tuple) for v in value):
        return value
    raise PydanticCustomError("level", "must be a finite number or [[time, value], ...]")


Level = Annotated[list[Pair], BeforeValidator(_level)]
Name = Annotated[str, Field(min_length=1)]


class CostSection(ConfigSection):
    """Keys of the cost."""

    name: str = Field("sse", description=one_of(COSTS))
    options: dict[str, Any] = Field(default_factory=dict, description="of the cost")
    function: str = Field(
        "",
        description='"module:name" of a Python function whose numbers take the place of the '
        "residuals; needs --allow-code",
    )
    time_base: Literal["measured", "union", "simulated", "both"] = Field(
        "measured",
        description="measured: each output at its own times; union: at the times of all outputs; "
        "simulated: every step seconds; both: union and simulated",
    )
    step: Finite | None = Field(
        None, gt=0.0, description="seconds of the simulated time base; default: model.step"
    )
    normalise: Literal["sigma", "max", "range"] = Field(
        "sigma",
        description="what residuals are divided by: sigma, or the measured signal's largest "
        "absolute value or range",
    )
    weights: dict[str, Annotated[Finite, Field(gt=0.0)]] = Field(
        default_factory=dict, description="FMU output = weight of its squares; default 1"
    )


class StepSection(ConfigSection):
    """Limits of a step response."""

    initial: Finite = Field(0.0, description="value before the step")
    final: Finite = Field(description="value that it settles at")
    time: Finite = Field(0.0, description="seconds; when the step begins")
    rise_time: Finite = Field(gt=0.0, description="seconds after which it must have risen")
    rise: Finite = Field(80.0, gt=0.0, lt=100.0, description="percent of the step by then")
    settling_time: Finite = Field(gt=0.0, description="seconds after which it must have settled")
    settling: Finite = Field(1.0, gt=0.0, description="percent of the step it may be off then")
    overshoot: Finite = Field(10.0, ge=0.0, description="percent of the step, until it settles")
    undershoot: Finite = Field(1.0, ge=0.0, description="percent of the step, while it rises")


class TrackingSection(ConfigSection):
    """A band around a measured signal."""

    absolute: Finite = Field(0.0, ge=0.0, description="tolerance in the signal's unit")
    relative: Finite = Field(0.0, ge=0.0, description="and this part of the measured value")
    side: Literal["both", "upper", "lower"] = Field(
        "both", description="upper: the signal must only not be above; lower: not below"
    )


class ConstraintSection(ConfigSection):
    """Keys of a constraint on parameters, on a signal, or by a function."""

    name: str = Field("", description="for tables; default: what it says")
    expression: str = Field(
        "", description='on parameters: two formulas with <=, >= or = between, "mu_d <= mu_s"'
    )
    signal: str = Field("", description="on a variable of the FMU")
    function: str = Field(
        "",
        description='"module:name" of a Python function that returns a number that must be at '
        "most 0; needs --allow-code",
    )
    equality: bool = Field(False, description="for a function: the number must be 0")
    lower: Level | None = Field(None, description="number, or [[time, value], ...]")
    upper: Level | None = Field(None, description="number, or [[time, value], ...]")
    step_response: StepSection | None = Field(None, description="envelope of a step response")
    tracking: TrackingSection | None = Field(
        None, description="band around the measured signal, in each experiment that has it"
    )
    final: Finite | None = Field(None, description="value at the end of the simulation")
    tolerance: Finite = Field(0.0, ge=0.0, description="how far it may be off; 0: an equality")
    between: Annotated[tuple[Finite, Finite], Strict(False)] | None = Field(
        None, description="[from, to] seconds; default: the whole simulation"
    )
    samples: Samples = Field(200, description="times at which the signal is checked, evenly spaced")
    scale: Finite | None = Field(
        None, gt=0.0, description="what a violation is counted in; default: the size of its limits"
    )
    experiments: list[str] = Field(
        default_factory=list, description="ids of the experiments; default: all"
    )


class MethodSection(ConfigSection):
    """Keys of the method."""

    name: str = Field("least_squares", description="see the documentation: which method when")
    options: dict[str, Any] = Field(default_factory=dict, description="of the method")
    seed: Count = Field(0, description="of the method's random generator")
    shooting: Shooting | None = Field(
        None,
        description="{ segments = 20 } or { length = 0.5 }: go through parts of the records first, "
        "each from states that are estimated too; for models that are chaotic, unstable or drift",
    )


class SensitivitySection(SensitivitySettings):
    """Keys of a sensitivity analysis."""

    seed: Count = Field(0, description="starts the random generators")


class MapSection(ConfigSection):
    """Keys of a one-dimensional map."""

    variables: list[str] = Field(
        min_length=2, description="the FMU's names of its values, in the order of the points"
    )
    points: list[Finite] = Field(
        min_length=2, description="where the values hold, increasing, in the unit of the abscissa"
    )
    start: Finite | list[Finite] = Field(
        description="where the estimation starts: a number, or one for each point"
    )
    bounds: Annotated[tuple[float, float], Strict(False)] = Field(
        (float("-inf"), float("inf")),
        description="[lower, upper] of every value; with slope_change of the first one, and of "
        "what the others may differ from it by in one interval",
    )
    slope_change: Finite | None = Field(
        None,
        gt=0.0,
        description="smoothness: standard deviation of the change of its slope over one unit of "
        "the abscissa, a prior; default: none; needs finite bounds",
    )
    monotone: Monotone = Field("", description="increasing or decreasing: a constraint")
    fixed: bool = Field(False, description="keep every value at its start")
    unit: str = Field("", description="of its values, for tables; default: the FMU's")
