"""TOML to the objects of a fit: the only reader of config files.

Every key stands here once, with its type, its default and a line that says what it is; an unknown
key is an error that names the nearest known one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    Strict,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from cluster_est.costs import COSTS
from cluster_est.errors import ConfigError
from cluster_est.executors import EXECUTORS
from cluster_est.methods import ALIASES, METHODS
from cluster_est.overrides import override
from cluster_est.sentences import sentences
from workers.description import nearest

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
    bounds: Pair | None = Field(None, description="[lower, upper]; default: what physics allows")
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
    cost: CostSection = Field(CostSection(), description="what is minimised")
    method: MethodSection = Field(MethodSection(), description="how")
    executor: ExecutorSection = Field(ExecutorSection(), description="where")
    budget: BudgetSection = Field(BudgetSection(), description="for how long")


def read_config(path: Path, overrides: list[str] | None = None) -> Config:
    """Read and check a config file.

    Parameters
    ----------
    path
        The TOML file.
    overrides
        "key=value" with dots in the key, as on the command line.

    Raises
    ------
    ConfigError
        If there is no such file, it is not TOML, or a key is unknown or has a wrong value.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigError(f"there is no config file {path}; check the path") from None
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: must be text in UTF-8 but is not ({error.reason} at byte {error.start}); "
            "save it as UTF-8"
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: must be a file that can be read but cannot be ({error.strerror}); check "
            "the path"
        ) from error
    except (ValueError, RecursionError) as error:  # tomllib lets more out than its own error
        raise ConfigError(f"{path}: must be TOML but is not: {error}; mend that line") from None
    for text in overrides or []:
        override(raw, text)
    return parse_config(raw, str(path))


def parse_config(raw: dict[str, Any], where: str) -> Config:
    """Check a config that is already in memory; `where` opens each message.

    Raises
    ------
    ConfigError
        With one line for each problem.
    """
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        raise ConfigError("\n".join(sentences(error, where, raw, Config))) from None
    problems = [*_unknown_names(config)]
    for experiment in config.experiments:
        problems += _contradictions(experiment)
    if problems:
        raise ConfigError("\n".join(f"{where}: {problem}" for problem in problems))
    return config


def _unknown_names(config: Config) -> Iterator[str]:
    choices: list[tuple[str, str, list[str]]] = [
        ("cost.name", config.cost.name, list(COSTS)),
        ("method.name", config.method.name, [*METHODS, *ALIASES]),
        ("executor.name", config.executor.name, list(EXECUTORS)),
    ]
    for key, name, known in choices:
        if name not in known:
            yield f"{key}: there is no {name!r}{nearest(name, known)}"


def _contradictions(experiment: ExperimentSection) -> Iterator[str]:
    """What can be seen to be wrong before any file is read."""
    where = f"experiments[{experiment.id!r}]"
    if (experiment.time is None) == (experiment.sample_time is None):
        has = "neither; add one" if experiment.time is None else "both; remove one"
        yield f"{where}: must have either time (a column) or sample_time (seconds) but has {has}"
    for name in experiment.sigma:
        if name not in experiment.outputs:
            yield (
                f"{where}.sigma.{name}: must be named as one of its outputs but is not"
                f"{nearest(name, experiment.outputs)}"
            )
    for name in experiment.outputs:
        if name in experiment.inputs:
            yield (
                f"{where}.outputs.{name}: must not be an input of the same experiment, because "
                "the FMU computes nothing there; remove one of the two"
            )
    start, stop = experiment.start, experiment.stop
    if start is not None and stop is not None and not start < stop:
        yield f"{where}.start: must be before stop, {stop:g} s, but is {start:g} s; change one"
    for i, (first, last) in enumerate(experiment.windows):
        if not first <= last:
            yield (
                f"{where}.windows[{i}]: must be [from, to] with from before to but is "
                f"[{first:g}, {last:g}]; swap them"
            )
    if experiment.rows is not None and not experiment.rows[0] < experiment.rows[1]:
        yield (
            f"{where}.rows: must be [from, to] with from below to but is "
            f"{list(experiment.rows)}; swap them, or remove the key to use all rows"
        )
