"""A found effect as it is written into a config, so that it can be named and just fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from cluster_est.closed_loop.findings.effects import NamedEffect
from cluster_est.problem.parameter import Parameter
from cluster_est.results.fit_tables import Estimate
from cluster_est.toml import dotted, inline
from workers.messages import Effect


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
