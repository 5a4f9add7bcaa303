"""The result of a closed loop as rows of tables and as the facts of run.json."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.closed_loop.findings.config_block import config_block
from cluster_est.closed_loop.findings.result import ErrorChange, LoopResult, NamedEffect
from cluster_est.results.row_types import Estimate

Row = dict[str, Any]

EFFECTS = pa.schema(
    [
        *((name, pa.string()) for name in ("effect", "family", "site", "form")),
        ("variables", pa.list_(pa.string())),
        *((name, pa.string()) for name in ("equation", "coefficient")),
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
        ("imitated_by", pa.string()),
    ]
)
SHAPES = pa.schema(
    [
        *((name, pa.string()) for name in ("effect", "part", "variable", "variable_unit", "unit")),
        *(
            (name, pa.list_(pa.float64()))
            for name in ("x", "y", "lower", "upper", "edges", "counts")
        ),
        ("why_not", pa.string()),
    ]
)
BEFORE = ("value", "std_error", "lower95", "upper95")


def parameter_rows(result: LoopResult) -> list[Row]:
    """Every estimate of the final model, and what it was without the effects (NaN if new)."""
    old = {e.label: e for e in result.before.estimates}
    rows = []
    for estimate in result.after.estimates:
        then = old.get(estimate.label)
        added = {f"{k}_before": getattr(then, k) if then else np.nan for k in BEFORE}
        rows.append(dataclasses.asdict(estimate) | added)
    return rows


def error_rows(result: LoopResult) -> list[Row]:
    """The errors of the declared model fitted, and with the effects."""
    rows = []
    for change, old, new in zip(
        result.errors, result.before.errors, result.after.errors, strict=True
    ):
        row = dataclasses.asdict(change)
        row |= {"relative_before": old.relative_after, "relative_after": new.relative_after}
        rows.append(row)
    return rows


def parameter_table(result: LoopResult) -> pa.Table:
    """`parameter_rows` as a table."""
    return pa.Table.from_pylist(parameter_rows(result))


def error_table(result: LoopResult) -> pa.Table:
    """`error_rows` as a table."""
    return pa.Table.from_pylist(error_rows(result))


def effect_table(result: LoopResult) -> pa.Table:
    """A row for each coefficient of each effect that was added."""
    rows = [
        {
            "effect": effect.name,
            "family": effect.family,
            "site": effect.site,
            "form": effect.form,
            "variables": list(effect.variables),
            "equation": effect.equation,
            "coefficient": _coefficient(effect, estimate),
            **_numbers(estimate),
        }
        for effect in result.effects
        for estimate in effect.coefficients
    ]
    return pa.Table.from_pylist(rows, schema=EFFECTS)


def shape_table(result: LoopResult) -> pa.Table:
    """A row for each shape of each effect that was added; its points are lists."""
    return pa.Table.from_pylist([dataclasses.asdict(each) for each in result.drawn], schema=SHAPES)


def finding_table(result: LoopResult) -> pa.Table:
    """Every candidate of every step with its score."""
    rows = [dataclasses.asdict(f) | {"variables": list(f.variables)} for f in result.findings]
    return pa.Table.from_pylist(rows, schema=FINDINGS)


def facts(result: LoopResult) -> Row:
    """What run.json says of a closed loop, besides what it says of any run."""
    return {
        "verdict": str(result.verdict),
        "summary": result.summary,
        "effects": [effect_facts(effect) for effect in result.effects],
        "rejected": [effect_facts(effect) for effect in result.rejected],
        "errors": {
            role: {when: result.rms(role, when) for when in ("before", "after")}
            for role in ("train", "test")
        },
        "errors_by_output": _errors_by_output(result.errors),
        "noise": result.noise,
        "notes": list(result.notes),
        "sites": list(result.sites),
        "experiments_simulated": result.simulations,
    }


def effect_facts(effect: NamedEffect) -> Row:
    """One effect, with what it cannot be told apart from and a block for a config."""
    return {
        "name": effect.name,
        "family": effect.family,
        "site": effect.site,
        "form": effect.form,
        "variables": list(effect.variables),
        "equation": effect.equation,
        "parameters": {_coefficient(effect, e): _numbers(e) for e in effect.coefficients},
        "alternatives": [dataclasses.asdict(a) for a in effect.alternatives],
        "evidence": list(effect.evidence),
        "config": config_block(effect),
    }


def _numbers(estimate: Estimate) -> Row:
    kept = {k: getattr(estimate, k) for k in ("value", "unit", "std_error", "lower95", "upper95")}
    return kept | {"fixed": estimate.estimated_on == "known"}


def _coefficient(effect: NamedEffect, estimate: Estimate) -> str:
    return estimate.parameter.removeprefix(f"{effect.name}.")


def _errors_by_output(errors: tuple[ErrorChange, ...]) -> Row:
    """Root mean square error of each output over all experiments with a role, in its unit."""
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
    samples = np.array([e.samples for e in rows], np.float64)
    return float(np.sqrt((samples * np.array(values) ** 2).sum() / samples.sum()))
