"""The findings of a closed loop as rows of tables, facts of run.json and blocks of a config."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

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
FINDINGS = pa.schema(
    [
        ("step", pa.int64()),
        *((name, pa.string()) for name in ("site", "form", "family")),
        ("variables", pa.list_(pa.string())),
        ("statistic", pa.float64()),
        ("freedom", pa.int64()),
        *((name, pa.float64()) for name in ("log_p", "explained", "distinct")),
        ("stage", pa.string()),
        ("criterion", pa.float64()),
        ("confounded_with", pa.string()),
    ]
)
STRUCTURES = pa.schema(
    [
        ("step", pa.int64()),
        ("effects", pa.list_(pa.string())),
        *((name, pa.float64()) for name in ("criterion", "closed")),
        *((name, pa.bool_()) for name in ("converged", "accepted")),
        ("relative_steps", pa.float64()),
        ("probability", pa.float64()),
        ("chosen", pa.float64()),
        *((name, pa.string()) for name in ("move", "stopped_by")),
        *((name, pa.float64()) for name in ("left_out", "held_out")),
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


def finding_table(findings: Sequence[CandidateEvidence]) -> pa.Table:
    """Make a row for every candidate of every step."""
    rows = [
        {name: getattr(finding, name) for name in FINDINGS.names}
        | {"variables": list(finding.variables), "stage": finding.stage.value}
        for finding in findings
    ]
    return pa.Table.from_pylist(rows, schema=FINDINGS)


def structure_table(path: Sequence[ComparedStructure]) -> pa.Table:
    """Make a row for every set of effects that was refitted."""
    rows = [
        {name: getattr(each, name) for name in STRUCTURES.names} | {"effects": list(each.effects)}
        for each in path
    ]
    return pa.Table.from_pylist(rows, schema=STRUCTURES)


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


def errors_by_output(errors: Sequence[ErrorChange]) -> Row:
    """Return the root mean square error of each output of each role, in its unit."""
    found: Row = {}
    for output in dict.fromkeys(e.output for e in errors):
        rows = [e for e in errors if e.output == output]
        found[output] = {"unit": rows[0].unit}
        for role in ("train", "test"):
            own = [e for e in rows if e.role == role]
            found[output][role] = {
                "before": _pooled(own, [e.rmse_before for e in own]),
                "after": _pooled(own, [e.rmse_after for e in own]),
            }
    return found


def _pooled(rows: list[ErrorChange], values: list[float]) -> float:
    if not rows:
        return np.nan
    pairs = [(e.samples, value) for e, value in zip(rows, values, strict=True) if e.samples]
    if not pairs:  # an output may have no samples in an experiment: that is no failure
        return np.nan
    samples, errors = np.array(pairs, np.float64).T
    return float(np.sqrt((samples * errors**2).sum() / samples.sum()))


def config_block(effect: NamedEffect) -> str:
    """Return an entry of `[[effects]]` that starts from the values found.

    Bounds are those of the search, so that a fit that names the effect finds the same.
    """
    neutral = dict(effect.effect.coefficients)
    sections = {}
    for estimate in effect.coefficients:
        name = estimate.parameter.removeprefix(f"{effect.name}.")
        sections[name] = _section(estimate, neutral.get(name))
    return _block(effect.effect, sections)


def effect_block(effect: Effect, coefficients: Sequence[Parameter]) -> str:
    """Return the same for an effect whose coefficients are parameters that start as fitted."""
    neutral = dict(effect.coefficients)
    sections = {}
    for parameter in coefficients:
        name = parameter.name.removeprefix(f"{effect.name}.")
        section: dict[str, Any] = {"start": float(parameter.start), "neutral": neutral.get(name)}
        bounds = [float(parameter.lower), float(parameter.upper)]
        if any(map(math.isfinite, bounds)):
            section["bounds"] = bounds
        if parameter.scale != "linear":
            section["scale"] = parameter.scale
        if parameter.fixed:
            section["fixed"] = True
        if parameter.per:
            section["per"] = parameter.per
        sections[name] = section
    return _block(effect, sections)


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


def _section(estimate: Estimate, neutral: float | None) -> dict[str, Any]:
    section: dict[str, Any] = {"start": float(estimate.value), "neutral": neutral}
    bounds = [float(estimate.lower), float(estimate.upper)]
    if any(map(math.isfinite, bounds)) and estimate.estimated_on != "known":
        section["bounds"] = bounds
    if estimate.scale != "linear":
        section["scale"] = estimate.scale
    if estimate.estimated_on == "known":
        section["fixed"] = True
    if estimate.unit:
        section["unit"] = estimate.unit
    return section
