"""The keys of a config, section by section, as pydantic models."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, PrivateAttr, Strict
from pydantic_core import PydanticCustomError

from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.config.experiment_keys import ExperimentDefaultsSection, ExperimentSection
from cluster_est.executors import EXECUTORS
from cluster_est.problem.costs import COSTS
from cluster_est.problem.free_curves import Monotone
from cluster_est.problem.thinning import ThinningSettings
from cluster_est.running.multistart import Multistart
from cluster_est.running.resources import Budget, LogSettings, Resources
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.settings import ConfigSection, Count, Finite, KnownValue, Pair, Samples, one_of
from cluster_est.shooting.record_segments import Shooting
from cluster_est.uncertainty import UncertaintySettings


def _level(value: Any) -> Any:
    """A number, or points of a curve over time."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and abs(value) <= sys.float_info.max:
        return [(0.0, float(value))]
    if isinstance(value, list) and value and all(isinstance(v, list | tuple) for v in value):
        return value
    raise PydanticCustomError("level", "must be a finite number or [[time, value], ...]")


Level = Annotated[list[Pair], BeforeValidator(_level)]
Bounds = Annotated[tuple[float, float], Strict(False)]

TimeBase = Literal["measured", "union", "simulated", "both"]
Normalise = Literal["sigma", "max", "range"]


class CostSection(ConfigSection):
    """Keys of the cost."""

    name: str = Field("sse", description=one_of(COSTS))
    options: dict[str, Any] = Field(default_factory=dict, description="of the cost")
    function: str = Field(
        "",
        description='"module:name" of a Python function whose numbers take the place of the '
        "residuals; needs --allow-code",
    )
    time_base: TimeBase = Field(
        "measured",
        description="measured: each output at its own times; union: at the times of all outputs; "
        "simulated: every step seconds; both: union and simulated",
    )
    step: Finite | None = Field(
        None, gt=0.0, description="seconds of the simulated time base; default: model.step"
    )
    normalise: Normalise = Field(
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
    between: Pair | None = Field(
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
    bounds: Bounds = Field(
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


class ModelSection(ConfigSection):
    """Keys of the model and its solver."""

    fmu: str = Field(description="path of the FMU, from the config's folder")
    interface: Literal["auto", "model_exchange", "co_simulation"] = Field(
        "auto", description="which of the FMU's interfaces; auto prefers model exchange"
    )
    solver: Literal["auto", "dormand_prince", "rk4", "cvode", "fmu"] = Field(
        "auto",
        description="auto: dormand_prince for model exchange, fmu for co-simulation; "
        "cvode for stiff models",
    )
    step: Finite | None = Field(
        None,
        gt=0.0,
        description="seconds; the step of rk4, the longest step of the others; "
        "default: from one time in the data to the next, no limit for dormand_prince and cvode",
    )
    rtol: Finite | None = Field(
        None, gt=0.0, lt=1.0, description="relative tolerance; default 1e-8, the FMU's own for fmu"
    )
    atol: Finite | None = Field(
        None, gt=0.0, description="absolute tolerance over each state's nominal; default rtol"
    )
    max_steps: Count = Field(
        1_000_000,
        gt=0,
        description="steps from one time in the data to the next after which a simulation fails",
    )
    reset: Literal["auto", "reset", "instance", "process"] = Field(
        "auto",
        description="what every simulation begins with: a reset of the instance, a new instance "
        "or a new process; auto: the first that lets a simulation be repeated",
    )
    environment: dict[str, str] = Field(
        default_factory=dict,
        description="environment variable = its value, as the FMU needs it when it is loaded; with "
        "local they stay set in this process, where none may be something else already",
    )
    working_folder: str = Field(
        "",
        description='a folder in the FMU, such as "resources", that its process works in, for an '
        "FMU that opens its files by relative paths; not with local",
    )
    stop_time: bool | None = Field(
        None,
        description="whether the FMU is told when a simulation will end; default: only if it "
        "cannot be initialised otherwise",
    )
    units: dict[str, str] = Field(
        default_factory=dict,
        description="variable of the FMU or signal = its unit, where the FMU names none or "
        "another; for tables and words alone, no number changes",
    )


class ParameterSection(ConfigSection):
    """Keys of a parameter."""

    start: Finite | None = Field(
        None,
        description="where the estimation starts, in the FMU's unit; needed but for an expression",
    )
    bounds: Bounds = Field((float("-inf"), float("inf")), description="[lower, upper]")
    scale: Literal["linear", "log"] = Field("linear", description="log: methods see ln(value)")
    fixed: bool = Field(False, description="keep it at its start")
    variable: str = Field("", description="the FMU's name for it; default: the key")
    per: str | None = Field(
        None, description='"experiment" or "group:KEY" for a value of its own there; default shared'
    )
    unit: str = Field("", description="for tables; default: the FMU's")
    expression: str = Field(
        "", description='instead of start: a formula in other parameters, such as "2 * k1"'
    )
    auxiliary: bool = Field(
        False, description="not in the FMU: for expressions and constraints alone"
    )
    prior: dict[str, Any] = Field(
        default_factory=dict,
        description='known before the measurements: { name = "normal", mean = 2.0, sd = 0.1 } or '
        '{ name = "lognormal", median = 2.0, factor = 1.5 }; counts like a measurement, so every '
        "output needs its sigma",
    )


class CoefficientSection(ConfigSection):
    """Keys of an effect's coefficient."""

    start: Finite | None = Field(
        None, description="where the estimation starts; default: the value that does nothing"
    )
    bounds: Bounds | None = Field(
        None,
        description="[lower, upper]; default: what physics allows, and for a time constant, a "
        "width, a speed or a frequency a thousandth of its start at least",
    )
    scale: Literal["linear", "log"] | None = Field(
        None,
        description="log: methods see ln(value); default: log for a time constant, a width, a "
        "speed or a frequency whose start and bounds are above 0, else linear",
    )
    fixed: bool = Field(False, description="keep it at its start")
    neutral: Finite | None = Field(
        None, description="of an equation of your own: the value at which it does nothing"
    )
    per: str | None = Field(None, description='"experiment" or "group:KEY"; default shared')
    unit: str = Field("", description="for tables")
    prior: dict[str, Any] = Field(
        default_factory=dict, description="known before the measurements, as of a parameter"
    )


class EffectSection(ConfigSection):
    """Keys of an effect."""

    name: str = Field("", description="of the effect; default: its form")
    site: str = Field(
        description='"der(STATE)", "pair STATE,STATE", "input NAME", "output NAME" or '
        '"parameter NAME" of the FMU'
    )
    form: str = Field("", description="a form of the library, such as coulomb")
    variables: list[str] = Field(
        default_factory=list,
        description="states, inputs or signals it is a function of, or differences like "
        '"x - z"; default: the state of der(STATE), or the difference of a pair',
    )
    equation: str = Field("", description="instead of form: an equation in the FMU's names")
    reaction: str = Field(
        "", description="of an equation at a pair: what is added to the second state's derivative"
    )
    parameters: dict[str, CoefficientSection] = Field(
        default_factory=dict, description="its coefficients = { start, bounds, ... }"
    )
    slope_change: Finite | None = Field(
        None,
        gt=0.0,
        description="smoothness of a free curve, such as table: as of a map; default: none; needs "
        "finite bounds, and holds low and high at their starts",
    )
    monotone: Monotone = Field(
        "", description="of a free curve: increasing or decreasing: a constraint, as of a map"
    )
    bounds: Bounds | None = Field(
        None,
        description="[lower, upper] of every value of a free curve, as of a map; default: none",
    )


class ClosedLoopSection(LoopSettings):
    """Keys of the closed loop."""

    seed: Count = Field(0, description="of every random generator of the loop")


_RESOURCES = Resources()


class ExecutorSection(ConfigSection):
    """Keys of the executor and its limits."""

    name: str = Field(_RESOURCES.executor, description=one_of(EXECUTORS))
    workers: Count | None = Field(
        None, gt=0, description="default: every core of the cluster for ray, else 1"
    )
    instances: Count | None = Field(
        None,
        gt=0,
        description="of the FMU that may exist at once, over all workers; default: any number",
    )
    address: str | None = Field(
        None, description='of a Ray cluster, e.g. "auto"; default: this machine alone'
    )
    timeout: Finite = Field(
        _RESOURCES.limits.seconds,
        gt=0.0,
        description="seconds that one simulation may take; not with local",
    )
    stall: Finite = Field(
        _RESOURCES.limits.stall,
        gt=0.0,
        description="seconds that one may stand still, without a step that ends",
    )
    memory: Finite | None = Field(
        None, gt=0.0, description="MB that a worker's simulation may have; default: no limit"
    )
    growth: Finite = Field(
        _RESOURCES.limits.growth / 2.0**20,
        gt=0.0,
        description="MB by which an FMU may leak before its process is replaced",
    )


class Config(ConfigSection):
    """A whole config file."""

    model: ModelSection = Field(description="the FMU and how to integrate it")
    data_folders: list[str] = Field(
        default_factory=list,
        description="folders to look for data in, after the config's own; $NAME is replaced",
    )
    parameters: dict[str, ParameterSection] = Field(
        default_factory=dict, description="what to estimate"
    )
    maps: dict[str, MapSection] = Field(
        default_factory=dict,
        description="tables of values over points, each as parameters that belong together",
    )
    values: dict[str, KnownValue] = Field(
        default_factory=dict, description="known values of all experiments, by FMU name"
    )
    value_files: list[str] = Field(
        default_factory=list,
        exclude=True,  # the reader puts what is in them where it belongs
        description="files of values, .ssv (SSP) or .csv with columns name, value and unit: of "
        "parameters, variables of maps and coefficients (EFFECT.COEFFICIENT) they are starts, of "
        "others known values",
    )
    experiment_defaults: ExperimentDefaultsSection = Field(
        ExperimentDefaultsSection(),
        exclude=True,  # the reader puts them into the experiments
        description="keys that every experiment has unless it says otherwise: all but id",
    )
    experiments: list[ExperimentSection] = Field(min_length=1, description="measured runs")
    effects: list[EffectSection] = Field(
        default_factory=list, description="terms that are added to the model"
    )
    closed_loop: ClosedLoopSection = Field(
        ClosedLoopSection(), description="how close-loop looks for what the model lacks"
    )
    cost: CostSection = Field(CostSection(), description="what is minimised")
    constraints: list[ConstraintSection] = Field(
        default_factory=list, description="what parameters and signals must satisfy"
    )
    method: MethodSection = Field(MethodSection(), description="how")
    multistart: Multistart = Field(Multistart(), description="from how many starts")
    uncertainty: UncertaintySettings = Field(
        UncertaintySettings(), description="intervals that take refits"
    )
    sensitivity: SensitivitySection = Field(
        SensitivitySection(), description="what cluster-est sensitivity samples and computes"
    )
    thinning: ThinningSettings = Field(
        ThinningSettings(), description="how many rows of long records a step is done on"
    )
    executor: ExecutorSection = Field(ExecutorSection(), description="where")
    budget: Budget = Field(Budget(), description="for how long")
    log: LogSettings = Field(LogSettings(), description="how much of each simulation is kept")
    _units_of_files: Mapping[str, str] = PrivateAttr(default_factory=dict)

    @property
    def units_of_files(self) -> Mapping[str, str]:
        """The units that `value_files` name, by the FMU's names."""
        return self._units_of_files

    def with_units_of_files(self, units: Mapping[str, str]) -> Self:
        """Return a config whose values of files are in these units."""
        changed = self.model_copy()
        changed._units_of_files = dict(units)
        return changed
