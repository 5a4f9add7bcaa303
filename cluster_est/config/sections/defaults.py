"""`[experiment_defaults]`: keys that every experiment has unless it says otherwise.

They are put into the experiments of the raw tree, before it is checked as a whole, so that nothing
else knows of them: a run's own config has every experiment with all of its keys.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from typing import Any

from cluster_est.config.sections.sections import Config
from cluster_est.toml import dotted
from workers.fmu.description import nearest

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
