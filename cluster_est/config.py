"""TOML to the objects of a fit: the only reader of config files.

Every key stands here once, with its type, its default and a line that says what it is; an unknown
key is an error that names the nearest known one.
"""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cluster_est.costs import COSTS
from cluster_est.errors import ConfigError
from cluster_est.executors import EXECUTORS
from cluster_est.methods import ALIASES, METHODS
from workers.description import nearest

Number = float
Known = float | int | bool


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
    step: float | None = Field(
        None,
        gt=0.0,
        description="seconds; the step of rk4, the longest step of the others; "
        "default: from one time in the data to the next, no limit for dormand_prince",
    )
    rtol: float | None = Field(
        None, gt=0.0, lt=1.0, description="relative tolerance; default 1e-8, the FMU's own for fmu"
    )
    atol: float | None = Field(
        None, gt=0.0, description="absolute tolerance over each state's nominal; default rtol"
    )
    max_steps: int = Field(1_000_000, gt=0, description="steps after which a simulation fails")


class ParameterSection(_Section):
    start: Number = Field(description="where the estimation starts, in the FMU's unit")
    bounds: tuple[Number, Number] = Field(
        (float("-inf"), float("inf")), strict=False, description="[lower, upper]"
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
    factor: float = Field(1.0, description="the column is multiplied by it")
    offset: float = Field(0.0, description="and this is added, in the new unit")
    demean: bool = Field(False, description="subtract the mean of the used rows first")


class ExperimentSection(_Section):
    id: str = Field(min_length=1, description="name of the experiment, unique")
    data: str = Field(description="path of the table: csv, parquet, feather or mat")
    time: str | None = Field(None, description="column with the time in seconds")
    sample_time: float | None = Field(
        None, gt=0.0, description="seconds between rows, where there is no time column"
    )
    rows: tuple[int, int] | None = Field(
        None, strict=False, description="[from, to]: rows from (counted from 0) up to, not with, to"
    )
    inputs: dict[str, str | InputSection] = Field(
        default_factory=dict, description="FMU input = column, or { column, interpolation }"
    )
    outputs: dict[str, str] = Field(description="FMU output = column; empty cells: not measured")
    sigma: dict[str, float] = Field(
        default_factory=dict, description="FMU output = standard deviation of its noise; default 1"
    )
    start: float | None = Field(None, description="seconds; default: the first time in the data")
    stop: float | None = Field(None, description="seconds; default: the last measured time")
    windows: list[tuple[float, float]] = Field(
        default_factory=list, strict=False, description="[[from, to], ...] seconds that count"
    )
    role: Literal["train", "test"] = Field("train", description="test: held out, only reported")
    values: dict[str, Known] = Field(
        default_factory=dict, description="known values of this run, by FMU name"
    )
    group: str | dict[str, str] = Field(
        default_factory=dict, description='KEY = "label" for parameters that are per "group:KEY"'
    )
    columns: dict[str, ColumnSection] = Field(
        default_factory=dict, description="column = { factor, offset, demean }"
    )


class CostSection(_Section):
    name: str = Field("sse", description="sse: sum of squared residuals")


class MethodSection(_Section):
    name: str = Field("least_squares", description="least_squares or scipy_least_squares")
    options: dict[str, Any] = Field(default_factory=dict, description="of the method")
    seed: int = Field(0, ge=0, description="of the method's random generator")


class ExecutorSection(_Section):
    name: str = Field("local", description="local or ray")
    workers: int | None = Field(
        None, gt=0, description="default: 1 for local, every core of the cluster for ray"
    )
    address: str | None = Field(
        None, description='of a Ray cluster, e.g. "auto"; default: this machine alone'
    )


class BudgetSection(_Section):
    evaluations: int | None = Field(None, gt=0, description="points to evaluate at most")
    seconds: float | None = Field(None, gt=0.0, description="after which nothing new is asked")


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
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"there is no config file {path}; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: must be TOML but is not: {error}") from error
    for override in overrides or []:
        _override(raw, override)
    return parse_config(raw, str(path))


def parse_config(raw: dict[str, Any], where: str) -> Config:
    """Check a config that is already in memory; `where` opens each message."""
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        lines = [_sentence(where, problem, raw) for problem in error.errors()]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None
    _check_name(where, "cost.name", config.cost.name, list(COSTS))
    _check_name(where, "method.name", config.method.name, [*METHODS, *ALIASES])
    _check_name(where, "executor.name", config.executor.name, list(EXECUTORS))
    for experiment in config.experiments:
        if (experiment.time is None) == (experiment.sample_time is None):
            raise ConfigError(
                f"{where}: experiment {experiment.id!r}: must have either time (a column) or "
                f"sample_time (seconds) but has {'none' if experiment.time is None else 'both'}"
            )
    return config


def _check_name(where: str, key: str, name: str, known: list[str]) -> None:
    if name not in known:
        raise ConfigError(f"{where}: {key}: there is no {name!r}{nearest(name, known)}")


def _override(raw: dict[str, Any], text: str) -> None:
    """Put one key=value into the raw config."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(
            f"{text!r}: must be key=value with dots in the key, like method.options.trials=8"
        )
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value
    *parents, last = key.strip().split(".")
    target: Any = raw
    for part in parents:
        target = _descend(target, part, key)
    if isinstance(target, list):
        raise ConfigError(f"{text!r}: {key.rpartition('.')[0]} is a list; add an index or an id")
    target[last] = parsed


def _descend(target: Any, part: str, key: str) -> Any:
    """One step into the raw config; an experiment is found by its id or its position."""
    if isinstance(target, list):
        for position, item in enumerate(target):
            if part in (str(position), str(item.get("id"))):
                return item
        raise ConfigError(f"{key}: there is no {part!r} in that list; name an id or a position")
    found = target.setdefault(part, {})
    if not isinstance(found, dict | list):
        raise ConfigError(f"{key}: {part!r} is a value, not a table; remove what follows it")
    return found


def _sentence(where: str, problem: Any, raw: dict[str, Any]) -> str:
    """One of pydantic's errors as: where, what it must be, what it is, what to do."""
    parts = [str(p) for p in problem["loc"] if not _internal(p)]
    path = _path(parts, raw)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(parts[:-1])
        return f"{where}: unknown key {path}{nearest(parts[-1], known)}"
    if problem["type"] == "missing":
        return f"{where}: {path} is missing; it is {_description(parts)}"
    message = problem["msg"][0].lower() + problem["msg"][1:]
    message = re.sub(r"^input should", "must", message)
    message = message.replace("must be a valid", "must be a").replace("must have", "must have")
    shown = repr(problem["input"])
    shown = shown if len(shown) < 60 else shown[:57] + "..."
    return f"{where}: {path}: {message} but is {shown}"


def _internal(part: object) -> bool:
    """Whether a part of pydantic's location is a type's name rather than a key."""
    return part in ("str", "InputSection", "dict[str,str]", "float", "int", "bool")


def _path(parts: list[str], raw: dict[str, Any]) -> str:
    """experiments.2.outputs as experiments[\"id of it\"].outputs."""
    if len(parts) > 1 and parts[0] == "experiments" and parts[1].isdigit():
        listed = raw.get("experiments")
        entry = listed[int(parts[1])] if isinstance(listed, list) else {}
        name = entry.get("id", parts[1]) if isinstance(entry, dict) else parts[1]
        return ".".join([f"experiments[{name!r}]", *parts[2:]])
    return ".".join(parts)


def _section(parts: list[str]) -> type[BaseModel] | None:
    """The section that a path of keys leads to."""
    named: dict[str, type[BaseModel]] = {
        "model": ModelSection,
        "cost": CostSection,
        "method": MethodSection,
        "executor": ExecutorSection,
        "budget": BudgetSection,
    }
    if not parts:
        return Config
    if parts[0] == "parameters":
        return ParameterSection
    if parts[0] == "experiments":
        nested: dict[str, type[BaseModel]] = {"columns": ColumnSection, "inputs": InputSection}
        return nested.get(parts[2], ExperimentSection) if len(parts) > 2 else ExperimentSection
    return named.get(parts[0])


def _known_keys(parts: list[str]) -> list[str]:
    section = _section(parts)
    return list(section.model_fields) if section is not None else []


def _description(parts: list[str]) -> str:
    section = _section(parts[:-1])
    found = section.model_fields.get(parts[-1]) if section is not None else None
    return (found.description or "needed") if found is not None else "needed"


def find_file(name: str, base: Path, folders: list[str], where: str) -> Path:
    """Look for a file beside the config, then in the data folders.

    Raises
    ------
    ConfigError
        If it is in none of them; the message lists them all.
    """
    tried = []
    for folder in [".", *folders]:
        expanded = os.path.expandvars(folder)
        if "$" in expanded:
            continue
        candidate = base / Path(expanded).expanduser() / Path(os.path.expandvars(name)).expanduser()
        if candidate.is_file():
            return candidate
        tried.append(str(Path(os.path.normpath(candidate))))
    raise ConfigError(f"{where}: there is no file {name!r}; looked for {', '.join(tried)}")
