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
    """Return a number or a curve over time as a list of points."""
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
    options: dict[str, Any] = Field(default_factory=dict, description="options of the cost")
    function: str = Field(
        "",
        description='"module:name" of a Python function that returns numbers to be used instead of '
        "the residuals; needs --allow-code",
    )
    time_base: TimeBase = Field(
        "measured",
        description="times at which outputs are compared; measured: each output at its own times; "
        "union: each output at the times of all outputs; simulated: every cost.step "
        "seconds; both: union and simulated",
    )
    step: Finite | None = Field(
        None,
        gt=0.0,
        description="interval in seconds between the times of the simulated time base; default: "
        "model.step",
    )
    normalise: Normalise = Field(
        "sigma",
        description="what residuals are divided by; sigma: the standard deviation of the noise; "
        "max: the largest absolute measured value; range: the range of the measured "
        "values",
    )
    weights: dict[str, Annotated[Finite, Field(gt=0.0)]] = Field(
        default_factory=dict, description="FMU output = weight of its squared residuals; default: 1"
    )


class StepSection(ConfigSection):
    """Limits of a step response."""

    initial: Finite = Field(0.0, description="value before the step")
    final: Finite = Field(description="final value of the step")
    time: Finite = Field(0.0, description="time of the step in seconds")
    rise_time: Finite = Field(
        gt=0.0, description="time in seconds after the step by which the signal must have risen"
    )
    rise: Finite = Field(
        80.0,
        gt=0.0,
        lt=100.0,
        description="percent of the step that the signal must reach by rise_time",
    )
    settling_time: Finite = Field(
        gt=0.0, description="time in seconds after the step by which the signal must have settled"
    )
    settling: Finite = Field(
        1.0, gt=0.0, description="largest deviation after settling_time, in percent of the step"
    )
    overshoot: Finite = Field(
        10.0,
        ge=0.0,
        description="largest overshoot until the signal settles, in percent of the step",
    )
    undershoot: Finite = Field(
        1.0, ge=0.0, description="largest undershoot while the signal rises, in percent of the step"
    )


class TrackingSection(ConfigSection):
    """A band around a measured signal."""

    absolute: Finite = Field(0.0, ge=0.0, description="tolerance in the signal's unit")
    relative: Finite = Field(
        0.0, ge=0.0, description="additional tolerance, as a fraction of the measured value"
    )
    side: Literal["both", "upper", "lower"] = Field(
        "both",
        description="upper: only the upper limit of the band counts; lower: only the lower limit",
    )


class ConstraintSection(ConfigSection):
    """Keys of a constraint on parameters, on a signal, or by a function."""

    name: str = Field("", description="name shown in tables; default: the text of the constraint")
    expression: str = Field(
        "",
        description="constraint on parameters: two formulas with <=, >= or = between them, such as "
        '"mu_d <= mu_s"',
    )
    signal: str = Field("", description="name of the FMU variable that is limited")
    function: str = Field(
        "",
        description='"module:name" of a Python function that returns a number, which must be at '
        "most 0; needs --allow-code",
    )
    equality: bool = Field(False, description="for a function: the number must be 0")
    lower: Level | None = Field(
        None, description="lower limit of the signal: a number, or [[time, value], ...]"
    )
    upper: Level | None = Field(
        None, description="upper limit of the signal: a number, or [[time, value], ...]"
    )
    step_response: StepSection | None = Field(None, description="envelope of a step response")
    tracking: TrackingSection | None = Field(
        None,
        description="band around the measured signal, in each experiment in which it is measured",
    )
    final: Finite | None = Field(
        None, description="value that the signal must have at the end of the simulation"
    )
    tolerance: Finite = Field(
        0.0, ge=0.0, description="largest allowed deviation from final; 0: an equality"
    )
    between: Pair | None = Field(
        None,
        description="[from, to] in seconds: when the signal is limited; default: during the whole "
        "simulation",
    )
    samples: Samples = Field(
        200, description="number of evenly spaced times at which the signal is checked"
    )
    scale: Finite | None = Field(
        None,
        gt=0.0,
        description="number by which a violation is divided; default: the size of the limits",
    )
    experiments: list[str] = Field(
        default_factory=list,
        description="ids of the experiments in which the constraint holds; default: all",
    )


class MethodSection(ConfigSection):
    """Keys of the method."""

    name: str = Field(
        "least_squares",
        description='name of the method; the page "Which method" of the documentation helps to '
        "choose",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="options of the method")
    seed: Count = Field(0, description="seed of the method's random generator")
    shooting: Shooting | None = Field(
        None,
        description="multiple shooting, { segments = 20 } or { length = 0.5 }: cut records into "
        "segments whose initial states are estimated too; for chaotic, unstable or "
        "drifting models",
    )


class SensitivitySection(SensitivitySettings):
    """Keys of a sensitivity analysis."""

    seed: Count = Field(0, description="seed of the random generators")


class MapSection(ConfigSection):
    """Keys of a one-dimensional map."""

    variables: list[str] = Field(
        min_length=2,
        description="FMU variables that hold the values of the map, in the order of the points",
    )
    points: list[Finite] = Field(
        min_length=2, description="abscissae to which the values belong, in increasing order"
    )
    start: Finite | list[Finite] = Field(
        description="start values of the estimation: one number, or one for each point"
    )
    bounds: Bounds = Field(
        (float("-inf"), float("inf")),
        description="[lower, upper] of every value; with slope_change: of the first value, and the "
        "first slope is at most upper - lower over the smallest distance between two points",
    )
    slope_change: Finite | None = Field(
        None,
        gt=0.0,
        description="smoothness of the map, as a prior: standard deviation of the change of slope "
        "over one unit of the abscissa; needs finite bounds; default: none",
    )
    monotone: Monotone = Field(
        "", description="constraint that makes the values monotonic: increasing or decreasing"
    )
    fixed: bool = Field(False, description="true: keep every value fixed at its start")
    unit: str = Field(
        "", description="unit of the values, shown in tables; default: the FMU's unit"
    )


class ModelSection(ConfigSection):
    """Keys of the model and its solver."""

    fmu: str = Field(description="path of the FMU, relative to the folder of the config")
    interface: Literal["auto", "model_exchange", "co_simulation"] = Field(
        "auto", description="interface of the FMU to use; auto prefers model exchange"
    )
    solver: Literal["auto", "dormand_prince", "rk4", "cvode", "fmu"] = Field(
        "auto",
        description="auto: dormand_prince for model exchange, fmu for co-simulation; "
        "cvode for stiff models",
    )
    step: Finite | None = Field(
        None,
        gt=0.0,
        description="step of rk4, or longest step of the other solvers, in seconds; default: the "
        "interval between times in the data, but no limit for dormand_prince and cvode",
    )
    rtol: Finite | None = Field(
        None,
        gt=0.0,
        lt=1.0,
        description="relative tolerance; default: 1e-8, or the FMU's own tolerance with solver fmu",
    )
    atol: Finite | None = Field(
        None,
        gt=0.0,
        description="absolute tolerance, relative to the nominal value of each state; default: "
        "rtol",
    )
    max_steps: Count = Field(
        1_000_000,
        gt=0,
        description="largest number of steps between two times in the data; a simulation that "
        "needs more fails",
    )
    reset: Literal["auto", "reset", "instance", "process"] = Field(
        "auto",
        description="how every simulation starts: with a reset of the instance, a new instance or "
        "a new process; auto: the first of these with which a repeated simulation "
        "gives the same result",
    )
    environment: dict[str, str] = Field(
        default_factory=dict,
        description="environment variable = its value, set before the FMU is loaded; with executor "
        "local, it is set in this process and must not already have another value "
        "there",
    )
    working_folder: str = Field(
        "",
        description="working folder of the FMU's process: a folder in the FMU, such as "
        '"resources"; for FMUs that open files by relative paths; not with executor '
        "local",
    )
    stop_time: bool | None = Field(
        None,
        description="whether the stop time is passed to the FMU; default: only if the FMU cannot "
        "be initialised without it",
    )
    units: dict[str, str] = Field(
        default_factory=dict,
        description="FMU variable or signal = its unit, if the FMU gives none or a wrong one; "
        "shown in tables and text; close-loop uses units to choose candidates and to name effects; "
        "no number is converted",
    )


class ParameterSection(ConfigSection):
    """Keys of a parameter."""

    start: Finite | None = Field(
        None,
        description="start value of the estimation, in the unit of the FMU; required unless "
        "there is an expression",
    )
    bounds: Bounds = Field((float("-inf"), float("inf")), description="[lower, upper]")
    scale: Literal["linear", "log"] = Field(
        "linear", description="log: methods work with ln(value)"
    )
    fixed: bool = Field(False, description="true: keep it fixed at its start")
    variable: str = Field("", description="name of the variable in the FMU; default: the key")
    per: str | None = Field(
        None,
        description='"experiment" or "group:KEY": a separate value for each experiment or group; '
        "default: one shared value",
    )
    unit: str = Field("", description="unit shown in tables; default: the FMU's")
    expression: str = Field(
        "",
        description="formula with other parameters that gives the value instead of start, such as "
        '"2 * k1"',
    )
    auxiliary: bool = Field(
        False,
        description="true: not a variable of the FMU, used only in expressions and constraints",
    )
    prior: dict[str, Any] = Field(
        default_factory=dict,
        description='prior knowledge: { name = "normal", mean = 2.0, sd = 0.1 } or { name = '
        '"lognormal", median = 2.0, factor = 1.5 }; it counts like a measurement, so '
        "every output needs its sigma",
    )


class CoefficientSection(ConfigSection):
    """Keys of an effect's coefficient."""

    start: Finite | None = Field(
        None,
        description="start value of the estimation; default: the value at which the effect has no "
        "influence",
    )
    bounds: Bounds | None = Field(
        None,
        description="[lower, upper]; default: the physical range; for a time constant, a width, a "
        "speed or a frequency, the lower bound is at least a thousandth of the start "
        "value",
    )
    scale: Literal["linear", "log"] | None = Field(
        None,
        description="log: methods work with ln(value); default: log for a time constant, a width, "
        "a speed or a frequency whose start and bounds are positive, otherwise linear",
    )
    fixed: bool = Field(False, description="true: keep it fixed at its start")
    neutral: Finite | None = Field(
        None, description="for your own equation: the value at which the effect has no influence"
    )
    per: str | None = Field(
        None,
        description='"experiment" or "group:KEY": a separate value for each; default: one shared '
        "value",
    )
    unit: str = Field("", description="for tables")
    prior: dict[str, Any] = Field(
        default_factory=dict, description="prior knowledge, as for a parameter"
    )


class EffectSection(ConfigSection):
    """Keys of an effect."""

    name: str = Field("", description="name of the effect; default: its form")
    site: str = Field(
        description='"der(STATE)", "pair STATE,STATE", "input NAME", "output NAME" or '
        '"parameter NAME" of the FMU'
    )
    form: str = Field("", description="name of a form in the library, such as coulomb")
    variables: list[str] = Field(
        default_factory=list,
        description='arguments of the effect: states, inputs, signals, or differences like "x - '
        'z"; default: the state of der(STATE), or the difference of the two states of '
        "a pair",
    )
    equation: str = Field("", description="equation with the FMU's variables, instead of form")
    reaction: str = Field(
        "",
        description="for an equation at a pair: the equation that is added to the derivative of "
        "the second state",
    )
    parameters: dict[str, CoefficientSection] = Field(
        default_factory=dict, description="its coefficients = { start, bounds, ... }"
    )
    slope_change: Finite | None = Field(
        None,
        gt=0.0,
        description="smoothness of a free curve such as table, as for a map; needs finite bounds; "
        "the coefficients low and high then stay at their starts; default: none",
    )
    monotone: Monotone = Field(
        "", description="constraint on a free curve, as for a map: increasing or decreasing"
    )
    bounds: Bounds | None = Field(
        None,
        description="[lower, upper] of every value of a free curve, as for a map; default: none",
    )


class ClosedLoopSection(LoopSettings):
    """Keys of the closed loop."""

    seed: Count = Field(0, description="seed of all random generators of the loop")


_RESOURCES = Resources()


class ExecutorSection(ConfigSection):
    """Keys of the executor and its limits."""

    name: str = Field(_RESOURCES.executor, description=one_of(EXECUTORS))
    workers: Count | None = Field(
        None,
        gt=0,
        description="number of workers; default: with ray, every core of the cluster, otherwise 1",
    )
    instances: Count | None = Field(
        None,
        gt=0,
        description="largest number of instances of the FMU at a time, over all workers; "
        "default: no limit",
    )
    address: str | None = Field(
        None, description='address of a Ray cluster, such as "auto"; default: only this machine'
    )
    timeout: Finite = Field(
        _RESOURCES.limits.seconds,
        gt=0.0,
        description="longest duration of one simulation in seconds; not with executor local",
    )
    stall: Finite = Field(
        _RESOURCES.limits.stall,
        gt=0.0,
        description="longest time in seconds that a simulation may run without finishing a step",
    )
    memory: Finite | None = Field(
        None, gt=0.0, description="largest memory of a simulation in MB; default: no limit"
    )
    growth: Finite = Field(
        _RESOURCES.limits.growth / 2.0**20,
        gt=0.0,
        description="memory in MB that an FMU may leak before its process is replaced",
    )


class Config(ConfigSection):
    """A whole config file."""

    model: ModelSection = Field(description="the FMU and its solver")
    data_folders: list[str] = Field(
        default_factory=list,
        description="folders in which data are looked for after the folder of the config; $NAME "
        "stands for an environment variable",
    )
    parameters: dict[str, ParameterSection] = Field(
        default_factory=dict, description="parameters to estimate"
    )
    maps: dict[str, MapSection] = Field(
        default_factory=dict,
        description="tables in the FMU whose values are parameters",
    )
    values: dict[str, KnownValue] = Field(
        default_factory=dict, description="known values for all experiments, by FMU name"
    )
    value_files: list[str] = Field(
        default_factory=list,
        exclude=True,  # the reader puts what is in them where it belongs
        description="files of values: .ssv (SSP), or .csv with the columns name, value and unit; "
        "values of parameters, variables of maps and coefficients (EFFECT.COEFFICIENT) "
        "become start values, all other values are known",
    )
    experiment_defaults: ExperimentDefaultsSection = Field(
        ExperimentDefaultsSection(),
        exclude=True,  # the reader puts them into the experiments
        description="default values for the keys of all experiments: any key except id",
    )
    experiments: list[ExperimentSection] = Field(min_length=1, description="measured runs")
    effects: list[EffectSection] = Field(
        default_factory=list, description="terms that are added to the model"
    )
    closed_loop: ClosedLoopSection = Field(
        ClosedLoopSection(), description="settings of close-loop"
    )
    cost: CostSection = Field(CostSection(), description="cost to be minimised")
    constraints: list[ConstraintSection] = Field(
        default_factory=list, description="constraints on parameters and signals"
    )
    method: MethodSection = Field(MethodSection(), description="how")
    multistart: Multistart = Field(Multistart(), description="number and choice of start points")
    uncertainty: UncertaintySettings = Field(
        UncertaintySettings(), description="intervals that need refits"
    )
    sensitivity: SensitivitySection = Field(
        SensitivitySection(), description="settings of cluster-est sensitivity"
    )
    thinning: ThinningSettings = Field(ThinningSettings(), description="thinning of long records")
    executor: ExecutorSection = Field(ExecutorSection(), description="where")
    budget: Budget = Field(Budget(), description="limits of the whole run")
    log: LogSettings = Field(LogSettings(), description="contents of the log")
    _units_of_files: Mapping[str, str] = PrivateAttr(default_factory=dict)

    @property
    def units_of_files(self) -> Mapping[str, str]:
        """The units that `value_files` contain, by the FMU's names."""
        return self._units_of_files

    def with_units_of_files(self, units: Mapping[str, str]) -> Self:
        """Return a config with the units of its files' values."""
        changed = self.model_copy()
        changed._units_of_files = dict(units)
        return changed
