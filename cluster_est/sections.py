"""Every key of a config file, once: its type, its default and a line that says what it is."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainValidator, Strict
from pydantic_core import PydanticCustomError

_LARGEST = 2**63 - 1
"""Of the integers that compiled code counts with."""


def _known(value: Any) -> Any:
    """A known value keeps its type: the FMU's variable decides which it must be."""
    largest = _LARGEST if isinstance(value, int) else float("inf")
    if isinstance(value, bool | int | float) and abs(value) < largest:
        return value
    raise PydanticCustomError("known", "must be a finite number, true or false")


def _input(value: Any) -> Any:
    if isinstance(value, str):
        return {"column": value}
    if isinstance(value, dict | InputSection):
        return value
    raise PydanticCustomError("input", "must be a column's name or { column, interpolation }")


def _group(value: Any) -> Any:
    if isinstance(value, str):
        return {"": value}
    if isinstance(value, dict):
        return value
    raise PydanticCustomError("group", 'must be a label or { KEY = "label" }')


Count = Annotated[int, Field(ge=0, le=_LARGEST)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Known = Annotated[float | int | bool, PlainValidator(_known)]
Pair = Annotated[tuple[Finite, Finite], Strict(False)]
"""TOML has lists, which strictly are no tuples."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ModelSection(_Section):
    fmu: str = Field(description="path of the FMU, from the config's folder")
    interface: Literal["auto", "model_exchange", "co_simulation"] = Field(
        "auto", description="which of the FMU's interfaces; auto prefers model exchange"
    )
    solver: Literal["auto", "dormand_prince", "rk4", "fmu"] = Field(
        "auto", description="auto: dormand_prince for model exchange, fmu for co-simulation"
    )
    step: Finite | None = Field(
        None,
        gt=0.0,
        description="seconds; the step of rk4, the longest step of the others; "
        "default: from one time in the data to the next, no limit for dormand_prince",
    )
    rtol: Finite | None = Field(
        None, gt=0.0, lt=1.0, description="relative tolerance; default 1e-8, the FMU's own for fmu"
    )
    atol: Finite | None = Field(
        None, gt=0.0, description="absolute tolerance over each state's nominal; default rtol"
    )
    max_steps: Count = Field(1_000_000, gt=0, description="steps after which a simulation fails")


class ParameterSection(_Section):
    start: Finite = Field(description="where the estimation starts, in the FMU's unit")
    bounds: Annotated[tuple[float, float], Strict(False)] = Field(
        (float("-inf"), float("inf")), description="[lower, upper]"
    )
    scale: Literal["linear", "log"] = Field("linear", description="log: methods see ln(value)")
    fixed: bool = Field(False, description="keep it at its start")
    variable: str = Field("", description="the FMU's name for it; default: the key")
    per: str | None = Field(
        None, description='"experiment" or "group:KEY" for a value of its own there; default shared'
    )
    unit: str = Field("", description="for tables; default: the FMU's")


class InputSection(_Section):
    column: str = Field(description="column of the data")
    interpolation: Literal["linear", "hold"] = Field("linear", description="between samples")


class ColumnSection(_Section):
    factor: Finite = Field(1.0, description="the column is multiplied by it")
    offset: Finite = Field(0.0, description="and this is added, in the new unit")
    demean: bool = Field(False, description="subtract the mean of the used rows first")


class ExperimentSection(_Section):
    id: str = Field(min_length=1, description="name of the experiment, unique")
    data: str = Field(description="path of the table: csv, parquet, feather or mat")
    time: str | None = Field(None, description="column with the time in seconds")
    sample_time: Finite | None = Field(
        None, gt=0.0, description="seconds between rows, where there is no time column"
    )
    rows: Annotated[tuple[Count, Count], Strict(False)] | None = Field(
        None, description="[from, to]: rows from (counted from 0) up to, not with, to"
    )
    inputs: dict[str, Annotated[InputSection, BeforeValidator(_input)]] = Field(
        default_factory=dict, description="FMU input = column, or { column, interpolation }"
    )
    outputs: dict[str, str] = Field(
        min_length=1, description="FMU output = column; empty cells: not measured"
    )
    signals: dict[str, Annotated[InputSection, BeforeValidator(_input)]] = Field(
        default_factory=dict,
        description="name = column, or { column, interpolation }: measured, but no input of the "
        "FMU; effects may depend on it",
    )
    sigma: dict[str, Annotated[Finite, Field(gt=0.0)]] = Field(
        default_factory=dict, description="FMU output = standard deviation of its noise; default 1"
    )
    start: Finite | None = Field(None, description="seconds; default: the first time in the data")
    stop: Finite | None = Field(None, description="seconds; default: the last measured time")
    windows: list[Pair] = Field(
        default_factory=list, description="[[from, to], ...] seconds that count"
    )
    role: Literal["train", "test"] = Field("train", description="test: held out, only reported")
    values: dict[str, Known] = Field(
        default_factory=dict, description="known values of this run, by FMU name"
    )
    group: Annotated[dict[str, str], BeforeValidator(_group)] = Field(
        default_factory=dict, description='KEY = "label" for parameters that are per "group:KEY"'
    )
    columns: dict[str, ColumnSection] = Field(
        default_factory=dict, description="column = { factor, offset, demean }"
    )


class CoefficientSection(_Section):
    start: Finite | None = Field(
        None, description="where the estimation starts; default: the value that does nothing"
    )
    bounds: Annotated[tuple[float, float], Strict(False)] | None = Field(
        None, description="[lower, upper]; default: what physics allows"
    )
    scale: Literal["linear", "log"] = Field("linear", description="log: methods see ln(value)")
    fixed: bool = Field(False, description="keep it at its start")
    neutral: Finite | None = Field(
        None, description="of an equation of your own: the value at which it does nothing"
    )
    per: str | None = Field(None, description='"experiment" or "group:KEY"; default shared')
    unit: str = Field("", description="for tables")


class EffectSection(_Section):
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
    parameters: dict[str, CoefficientSection] = Field(
        default_factory=dict, description="its coefficients = { start, bounds, ... }"
    )


class ClosedLoopSection(_Section):
    effects: list[str] = Field(
        default_factory=list, description="forms to try, such as coulomb; default: the library"
    )
    sites: list[str] = Field(
        default_factory=list, description='where to look, such as "der(v)"; default: all'
    )
    max_effects: Count = Field(3, gt=0, description="effects to add at most")
    significance: Finite = Field(
        0.01, gt=0.0, lt=1.0, description="largest p-value at which something counts as missing"
    )
    draws: Count = Field(2000, ge=100, description="Monte Carlo draws of each null distribution")
    trials: Count = Field(30, gt=0, description="candidates tried by a real simulation")
    refits: Count = Field(12, gt=0, description="of those, how many are refitted")
    starts: Count = Field(
        8, gt=0, description="starts of the declared fit, where one is not enough"
    )
    least_gain: Finite = Field(
        0.2, ge=0.0, description="share of the gap to the noise that an effect must close"
    )
    pairs: bool = Field(True, description="try two effects at once where no single one is enough")
    seed: Count = Field(0, description="of every random generator of the loop")


class CostSection(_Section):
    name: str = Field("sse", description="sse: sum of squared residuals")


class MethodSection(_Section):
    name: str = Field("least_squares", description="least_squares or scipy_least_squares")
    options: dict[str, Any] = Field(default_factory=dict, description="of the method")
    seed: Count = Field(0, description="of the method's random generator")


class ExecutorSection(_Section):
    name: str = Field("local", description="local or ray")
    workers: Count | None = Field(
        None, gt=0, description="default: 1 for local, every core of the cluster for ray"
    )
    address: str | None = Field(
        None, description='of a Ray cluster, e.g. "auto"; default: this machine alone'
    )


class BudgetSection(_Section):
    evaluations: Count | None = Field(None, gt=0, description="points to evaluate at most")
    seconds: Finite | None = Field(None, gt=0.0, description="after which nothing new is asked")


class Config(_Section):
    """A whole config file."""

    model: ModelSection = Field(description="the FMU and how to integrate it")
    data_folders: list[str] = Field(
        default_factory=list,
        description="folders to look for data in, after the config's own; $NAME is replaced",
    )
    parameters: dict[str, ParameterSection] = Field(
        default_factory=dict, description="what to estimate"
    )
    values: dict[str, Known] = Field(
        default_factory=dict, description="known values of all experiments, by FMU name"
    )
    experiments: list[ExperimentSection] = Field(min_length=1, description="measured runs")
    effects: list[EffectSection] = Field(
        default_factory=list, description="terms that are added to the model"
    )
    closed_loop: ClosedLoopSection = Field(
        ClosedLoopSection(), description="how close-loop looks for what the model lacks"
    )
    cost: CostSection = Field(CostSection(), description="what is minimised")
    method: MethodSection = Field(MethodSection(), description="how")
    executor: ExecutorSection = Field(ExecutorSection(), description="where")
    budget: BudgetSection = Field(BudgetSection(), description="for how long")
