"""TOML to the objects of a fit: the only reader of config files.

Its keys stand in `config/sections/`; an unknown key is an error that names the nearest known one.

The keys of `[experiment_defaults]`, which every experiment has unless it says otherwise, are put
into the experiments of the raw tree before it is checked as a whole, so that nothing else knows of
them: a run's own config has every experiment with all of its keys.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from cluster_est.config.sections.experiment import (
    ColumnSection,
    CurveSection,
    ExperimentDefaultsSection,
    ExperimentSection,
    InputSection,
    OutputSection,
)
from cluster_est.config.sections.sections import (
    ClosedLoopSection,
    CoefficientSection,
    Config,
    ConstraintSection,
    CostSection,
    EffectSection,
    ExecutorSection,
    MapSection,
    MethodSection,
    ModelSection,
    ParameterSection,
    StepSection,
    TrackingSection,
)
from cluster_est.config.sections.value_files import VALUE_FILES, with_values_of_files
from cluster_est.config.text import override, unfilled
from cluster_est.errors import ConfigError
from cluster_est.executors import EXECUTORS
from cluster_est.methods import ALIASES, METHODS
from cluster_est.problem.costs import ALIASES as COST_ALIASES
from cluster_est.problem.costs import COSTS
from cluster_est.problem.tables.measured import (
    missing_time,
    relative_without_sigma,
    sigma_without_output,
)
from cluster_est.settings import error_messages
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages.checks import as_path, as_tuple

DEFAULTS = "experiment_defaults"
SIGNALS = ("inputs", "outputs", "signals")
"""Tables whose entries are columns; an empty name takes an entry of the defaults away."""
SIGMAS = ("sigma", "relative_sigma")
"""Keys of an experiment with a number for each output."""
TIMES = ("time", "sample_time")
"""Keys that exclude each other: with one of its own an experiment does not take the other."""


def with_defaults(raw: dict[str, Any]) -> dict[str, Any]:
    """Return a config's tree without defaults, each experiment with what it takes of them.

    Parameters
    ----------
    raw
        As read from TOML. Its table of defaults is valid; whether its experiments are is found out
        afterwards.
    """
    kept = {key: value for key, value in raw.items() if key != DEFAULTS}
    experiments = raw.get("experiments")
    if isinstance(experiments, list):
        defaults = _long_forms(raw[DEFAULTS])
        kept["experiments"] = [
            _whole(defaults, _long_forms(own)) if isinstance(own, dict) else own
            for own in experiments
        ]
    return kept


def unused_defaults(defaults: dict[str, Any], config: Config) -> Iterator[str]:
    """Yield a sentence for each name in the defaults that means nothing to any experiment."""
    outputs = sorted({name for each in config.experiments for name in each.outputs})
    columns = sorted({name for each in config.experiments for name in _used(each.model_dump())})
    for key in SIGMAS:
        for name in defaults.get(key, {}):
            if name not in outputs:
                must = "must be named as an output of some experiment but is not"
                yield f"{DEFAULTS}.{key}.{name}: {must}{_beside(name, outputs)}"
    for name in defaults.get("columns", {}):
        if name not in columns:
            must = "must be named as a column that some experiment uses but is not"
            yield f"{DEFAULTS}.{dotted('columns', name)}: {must}{_beside(name, columns)}"


def _beside(name: str, known: list[str]) -> str:
    """Return the end of a message: either of two names may be the misspelt one."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f", only {near[0]!r} is; one of the two names may be wrong"
    return nearest(name, known)


def _long_forms(section: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of an experiment with tables in the place of their short forms."""
    found = dict(section)
    for key in SIGNALS:
        if isinstance(found.get(key), dict):
            found[key] = {
                name: {"column": each} if isinstance(each, str) else each
                for name, each in found[key].items()
            }
    if isinstance(found.get("group"), str):
        found["group"] = {"": found["group"]}
    return found


def _whole(defaults: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return an experiment with what it takes of the defaults."""
    timed = any(key in own for key in TIMES)
    taken = {k: v for k, v in defaults.items() if not (timed and k in TIMES)}
    for key in SIGNALS:
        gone = {name for name, each in _table(own, key).items() if each == {"column": ""}}
        gone &= set(_table(taken, key))
        if gone:
            taken[key] = {name: each for name, each in taken[key].items() if name not in gone}
            own = own | {key: {name: v for name, v in own[key].items() if name not in gone}}
    whole: dict[str, Any] = _joined(taken, own)
    of_outputs = set(_table(whole, "outputs"))
    for key, known in (*((key, of_outputs) for key in SIGMAS), ("columns", _used(whole))):
        if key in taken and isinstance(whole[key], dict):
            kept = {*known, *_table(own, key)}
            whole[key] = {name: each for name, each in whole[key].items() if name in kept}
    return whole


def _joined(default: Any, own: Any) -> Any:
    """Return tables joined name by name; of anything else an experiment's own wins."""
    if not isinstance(default, dict) or not isinstance(own, dict):
        return own
    both = {name: _joined(default[name], own[name]) for name in own if name in default}
    return default | own | both


def _table(section: dict[str, Any], key: str) -> dict[str, Any]:
    found = section.get(key)
    return found if isinstance(found, dict) else {}


def _used(experiment: dict[str, Any]) -> set[str]:
    """Return the columns that an experiment names."""
    named = [experiment.get("time")]
    for key in SIGNALS:
        named += [_table({"": each}, "").get("column") for each in _table(experiment, key).values()]
    named += _table(_table(experiment, "curve"), "columns").values()
    return {name for name in named if isinstance(name, str)}


__all__ = [
    "ClosedLoopSection",
    "CoefficientSection",
    "ColumnSection",
    "Config",
    "ConstraintSection",
    "CostSection",
    "CurveSection",
    "EffectSection",
    "ExecutorSection",
    "ExperimentDefaultsSection",
    "ExperimentSection",
    "InputSection",
    "MapSection",
    "MethodSection",
    "ModelSection",
    "OutputSection",
    "ParameterSection",
    "StepSection",
    "TrackingSection",
    "parse_config",
    "read_config",
]


def read_config(path: str | Path, overrides: Sequence[str] | None = None) -> Config:
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
    path = as_path(path, "config", ConfigError)
    changes = as_tuple(() if overrides is None else overrides, str, "overrides", ConfigError)
    try:
        text = path.read_text(encoding="utf-8-sig")
        raw = tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"there is no config file {path}; check the path") from None
    except UnicodeDecodeError as error:
        if path.suffix.lower() == ".fmu":
            raise ConfigError(
                f"{path}: must be a config but is an FMU; write one with cluster-est init"
            ) from None
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
    for change in changes:
        override(raw, change)
    open_ = list(unfilled(raw, text, str(path)))
    if open_:
        raise ConfigError("\n".join(open_))
    tree, units = with_values_of_files(raw, path.parent)
    return parse_config(tree, str(path)).with_units_of_files(units)


def parse_config(raw: dict[str, Any], where: str) -> Config:
    """Check a config that is already in memory; `where` opens each message.

    Raises
    ------
    ConfigError
        With one line for each problem.
    """
    if raw.get(VALUE_FILES):
        raise ConfigError(
            f"{where}.{VALUE_FILES}: is only for a config file; give the values themselves"
        )
    defaults = raw.get(DEFAULTS, {})
    if DEFAULTS in raw:
        with _in_words(raw, where):
            _OnlyDefaults.model_validate(raw)
        raw = with_defaults(raw)
    with _in_words(raw, where):
        config = Config.model_validate(raw)
    problems = [*_unknown_names(config), *unused_defaults(defaults, config)]
    problems += _missing_starts(config)
    constrained = bool(config.constraints or config.cost.function)
    for experiment in config.experiments:
        problems += _contradictions(experiment, constrained=constrained)
    if problems:
        raise ConfigError("\n".join(f"{where}: {problem}" for problem in problems))
    return config


class _OnlyDefaults(BaseModel):
    """A config of which only the defaults of the experiments are looked at."""

    experiment_defaults: ExperimentDefaultsSection


@contextmanager
def _in_words(raw: dict[str, Any], where: str) -> Iterator[None]:
    """Say what pydantic finds in the words of the config's author."""
    try:
        yield
    except ValidationError as error:
        raise ConfigError("\n".join(error_messages(error, where, raw, Config))) from None


def _unknown_names(config: Config) -> Iterator[str]:
    choices: list[tuple[str, str, list[str], list[str]]] = [
        ("cost.name", config.cost.name, list(COSTS), list(COST_ALIASES)),
        ("method.name", config.method.name, list(METHODS), list(ALIASES)),
        ("executor.name", config.executor.name, list(EXECUTORS), []),
    ]
    for key, name, known, aliases in choices:
        if name not in (*known, *aliases):
            yield f"{key}: there is no {name!r}{nearest(name, known)}"


def _missing_starts(config: Config) -> Iterator[str]:
    for name, parameter in config.parameters.items():
        key = dotted("parameters", name)
        if parameter.start is None and not parameter.expression:
            yield f"{key}.start is missing; add it (where the estimation starts, in the FMU's unit)"
        elif parameter.start is not None and parameter.expression:
            yield (
                f"{key}.start: must be left out where there is an expression, which says all of "
                "the value, but is there; remove one of the two"
            )


def _wrong_source(where: str, experiment: ExperimentSection, *, constrained: bool) -> Iterator[str]:
    """Data, times and what is measured, which depend on each other."""
    timed = experiment.outputs or experiment.inputs or experiment.signals
    given = [key for key in ("time", "sample_time") if getattr(experiment, key) is not None]
    if not experiment.outputs and experiment.curve is None and not constrained:
        yield f"{where}.outputs is missing; add it (FMU output = column), or a curve"
    elif experiment.data is None:
        if timed or experiment.curve is not None or given:
            yield f"{where}.data is missing; add it (path of the table: csv, parquet, feather, mat)"
    elif timed and len(given) != 1:
        yield missing_time(where, experiment.time, experiment.sample_time)
    if not timed and (experiment.start is None or experiment.stop is None):
        yield (
            f"{where}: must have start and stop in seconds, because no times are measured, but "
            "has not; add both"
        )


def _wrong_sigmas(where: str, experiment: ExperimentSection) -> Iterator[str]:
    for key in SIGMAS:
        for name in getattr(experiment, key):
            if name not in experiment.outputs:
                yield sigma_without_output(f"{where}.{key}", name, experiment.outputs)
    for name in experiment.relative_sigma:
        if name in experiment.outputs and name not in experiment.sigma:
            yield relative_without_sigma(where, name)


def _contradictions(experiment: ExperimentSection, *, constrained: bool) -> Iterator[str]:
    """Contradictions within an experiment's section, found before any file is read."""
    where = f"experiments[{experiment.id!r}]"
    yield from _wrong_source(where, experiment, constrained=constrained)
    yield from _wrong_sigmas(where, experiment)
    for name in experiment.outputs:
        if name in experiment.inputs:
            yield (
                f"{where}.outputs.{name}: must not be an input of the same experiment, because "
                "the FMU computes nothing there; remove one of the two"
            )
    start, stop = experiment.start, experiment.stop
    if start is not None and stop is not None and not start < stop:
        yield f"{where}.start: must be before stop, {stop:g} s, but is {start:g} s; change one"
    for key in ("windows", "test_windows"):
        for i, (first, last) in enumerate(getattr(experiment, key)):
            if not first <= last:
                yield (
                    f"{where}.{key}[{i}]: must be [from, to] with from before to but is "
                    f"[{first:g}, {last:g}]; swap them"
                )
    if experiment.rows is not None and not experiment.rows[0] < experiment.rows[1]:
        yield (
            f"{where}.rows: must be [from, to] with from below to but is "
            f"{list(experiment.rows)}; swap them, or remove the key to use all rows"
        )
