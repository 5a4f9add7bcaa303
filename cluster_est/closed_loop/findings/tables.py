"""The findings of a closed loop as rows of tables, facts of run.json and blocks of a config."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa

from cluster_est.closed_loop.findings.effects import ErrorChange, NamedEffect
from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.problem.parameter import Parameter
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.output_errors import OutputError
from cluster_est.toml import dotted, inline
from workers.messages import Effect

Row = dict[str, Any]

EFFECTS = pa.schema(
    [
        *((name, pa.string()) for name in ("effect", "family", "site", "form")),
        ("variables", pa.list_(pa.string())),
        *((name, pa.string()) for name in ("equation", "words", "coefficient")),
        ("value", pa.float64()),
        ("unit", pa.string()),
        *((name, pa.float64()) for name in ("std_error", "lower95", "upper95")),
        ("fixed", pa.bool_()),
    ]
)
BEFORE = ("value", "std_error", "lower95", "upper95")


def parameter_table(before: Sequence[Estimate], after: Sequence[Estimate]) -> pa.Table:
    """Make a row for each estimate of the final model, with that before (NaN if it is new)."""
    old = {e.label: e for e in before}
    rows = []
    for estimate in after:
        then = old.get(estimate.label)
        added = {f"{k}_before": getattr(then, k) if then else np.nan for k in BEFORE}
        rows.append(dataclasses.asdict(estimate) | added)
    return pa.Table.from_pylist(rows)


def error_table(
    changes: Sequence[ErrorChange], before: Sequence[OutputError], after: Sequence[OutputError]
) -> pa.Table:
    """Make a row for each output of each experiment: declared model fitted, and with effects."""
    rows = []
    for change, old, new in zip(changes, before, after, strict=True):
        row = dataclasses.asdict(change)
        row |= {"relative_before": old.relative_after, "relative_after": new.relative_after}
        rows.append(row)
    return pa.Table.from_pylist(rows)


def effect_table(effects: Sequence[NamedEffect]) -> pa.Table:
    """Make a row for each coefficient of each effect that was added."""
    rows = [
        {
            "effect": effect.name,
            "family": effect.family,
            "site": effect.site,
            "form": effect.form,
            "variables": list(effect.variables),
            "equation": effect.equation,
            "words": effect.words,
            "coefficient": _coefficient(effect, estimate),
            **_numbers(estimate),
        }
        for effect in effects
        for estimate in effect.coefficients
    ]
    return pa.Table.from_pylist(rows, schema=EFFECTS)


COLUMNS = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


def row_table(row: type, rows: Sequence[CandidateEvidence | ComparedStructure]) -> pa.Table:
    """Make a table of rows with a column for each of their fields, also where there are none."""
    hints = get_type_hints(row)
    schema = pa.schema([(f.name, _column(hints[f.name])) for f in dataclasses.fields(row)])
    return pa.Table.from_pylist([vars(each) for each in rows], schema=schema)


def _column(kind: Any) -> pa.DataType:
    if get_origin(kind) is tuple:
        return pa.list_(_column(get_args(kind)[0]))
    return next(column for known, column in COLUMNS.items() if issubclass(kind, known))


def effect_facts(effect: NamedEffect) -> Row:
    """Return one effect with its alternatives and a block for a config."""
    return {
        "name": effect.name,
        "family": effect.family,
        "site": effect.site,
        "form": effect.form,
        "variables": list(effect.variables),
        "equation": effect.equation,
        "words": effect.words,
        "sentence": effect.sentence,
        "also": [dataclasses.asdict(a) for a in effect.also],
        "period": effect.period,
        "parameters": {_coefficient(effect, e): _numbers(e) for e in effect.coefficients},
        "alternatives": [dataclasses.asdict(a) for a in effect.alternatives],
        "evidence": list(effect.evidence),
        "config": config_block(effect),
    }


def _numbers(estimate: Estimate) -> Row:
    kept = {k: getattr(estimate, k) for k in ("value", "unit", "std_error", "lower95", "upper95")}
    held = {"fixed": estimate.estimated_on == "known", "at_bound": estimate.at_bound}
    return kept | held


def _coefficient(effect: NamedEffect, estimate: Estimate) -> str:
    return estimate.parameter.removeprefix(f"{effect.name}.")


def config_block(effect: NamedEffect) -> str:
    """Return an entry of `[[effects]]` that starts from the values found.

    Bounds are those of the search, so that a fit that names the effect finds the same.
    """
    neutral, sections = dict(effect.effect.coefficients), {}
    for estimate in effect.coefficients:
        name, fixed = _coefficient(effect, estimate), estimate.estimated_on == "known"
        bounds = () if fixed else (estimate.lower, estimate.upper)
        section = _section(estimate.value, neutral.get(name), bounds, estimate.scale, fixed=fixed)
        sections[name] = section | ({"unit": estimate.unit} if estimate.unit else {})
    return _block(effect.effect, sections)


def effect_block(effect: Effect, coefficients: Sequence[Parameter]) -> str:
    """Return the same for an effect whose coefficients are parameters that start as fitted."""
    neutral, sections = dict(effect.coefficients), {}
    for parameter in coefficients:
        name, bounds = (
            parameter.name.removeprefix(f"{effect.name}."),
            (parameter.lower, parameter.upper),
        )
        section = _section(
            parameter.start, neutral.get(name), bounds, parameter.scale, fixed=parameter.fixed
        )
        sections[name] = section | ({"per": parameter.per} if parameter.per else {})
    return _block(effect, sections)


def _section(
    start: float, neutral: float | None, bounds: Sequence[float], scale: str, *, fixed: bool
) -> Row:
    section: Row = {"start": float(start), "neutral": neutral}
    if any(map(math.isfinite, bounds)):
        section["bounds"] = list(map(float, bounds))
    if scale != "linear":
        section["scale"] = scale
    return section | ({"fixed": True} if fixed else {})


def _block(effect: Effect, sections: Mapping[str, Mapping[str, Any]]) -> str:
    lines = [
        "[[effects]]",
        f"name = {inline(effect.name)}",
        f"site = {inline(effect.site)}",
        *([f"form = {inline(effect.form)}"] if effect.form else []),
        *([f"variables = {inline(list(effect.variables))}"] if effect.variables else []),
        *([f"equation = {inline(effect.equation)}"] if effect.equation else []),
        *([f"reaction = {inline(effect.reaction)}"] if effect.reaction else []),
        "[effects.parameters]",
    ]
    lines += [f"{dotted(name)} = {inline(section)}" for name, section in sections.items()]
    return "\n".join(lines) + "\n"
