"""A found effect as it is written into a config, so that it can be named and just fitted."""

from __future__ import annotations

import math
from typing import Any

from cluster_est.closed_loop.findings.effects import NamedEffect
from cluster_est.results.row_types import Estimate
from cluster_est.toml import dotted, inline


def config_block(effect: NamedEffect) -> str:
    """Return an entry of `[[effects]]` that starts from the values found.

    Bounds are those of the search, so that a fit that names the effect finds the same.
    """
    known = effect.effect
    lines = [
        "[[effects]]",
        f"name = {inline(effect.name)}",
        f"site = {inline(effect.site)}",
        *([f"form = {inline(effect.form)}"] if effect.form else []),
        *([f"variables = {inline(list(effect.variables))}"] if effect.variables else []),
        *([f"equation = {inline(known.equation)}"] if known.equation else []),
        *([f"reaction = {inline(known.reaction)}"] if known.reaction else []),
        "[effects.parameters]",
    ]
    neutral = dict(known.coefficients)
    for estimate in effect.coefficients:
        name = estimate.parameter.removeprefix(f"{effect.name}.")
        lines.append(f"{dotted(name)} = {inline(_section(estimate, neutral.get(name)))}")
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
