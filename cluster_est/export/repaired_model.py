"""A model with the estimates and effects of a run: what every form of export is made from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np

from cluster_est.closed_loop.candidates.equation import equation_text
from cluster_est.problem.problem import Problem
from workers.effects.definition import EffectDefinition
from workers.fmu.description import ModelDescription
from workers.messages import Value


@dataclass(frozen=True)
class EstimatedValue:
    """One estimated value.

    Attributes
    ----------
    name, unit, value
        The FMU's name for it, or "EFFECT.COEFFICIENT".
    low, high
        Its 95 % interval; NaN where the data do not determine it, or it was not estimated.
    lower, upper
        Its bounds, infinite where it has none.
    """

    name: str
    unit: str
    value: float
    low: float = math.nan
    high: float = math.nan
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def interval(self) -> str:
        """Its interval as text, "" if it has none."""
        return "" if math.isnan(self.low) else f"95 %: {self.low:.5g} .. {self.high:.5g}"


@dataclass(frozen=True)
class ReportedError:
    """The root mean square error of an output of an experiment, as the run reports it.

    Attributes
    ----------
    experiment, role, output, unit, samples
        Of what, and over how many samples.
    before, after
        Without and with what was found; NaN where it cannot be simulated.
    """

    experiment: str
    role: str
    output: str
    unit: str
    samples: int
    before: float
    after: float

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Self:
        """Return what a row of errors.parquet says."""
        named = {key: row[key] for key in ("experiment", "role", "output", "unit", "samples")}
        return cls(**named, before=row["rmse_before"], after=row["rmse_after"])


@dataclass(frozen=True)
class RepairedModel:
    """A model with the estimates and effects of a run.

    Attributes
    ----------
    run
        Name of the run's folder.
    problem, description
        What was simulated, all effects included.
    effects
        Those that do something with the values that were found, in the order in which they act.
    coefficients
        Of each of these effects.
    parameters
        The values of the FMU's own parameters and initial states.
    known
        The values that the experiment had besides.
    notes
        Sentences on what is not as in the run.
    ranges
        For each effect the range that its variable had in the data, as text; none where that is not
        known.
    errors
        What the run reports.
    without
        What its errors "before" are those of, as part of a sentence.
    of_experiments
        For each experiment by its id, the values of the FMU's parameters and initial states, and
        of coefficients that differ between experiments, by the exported FMU's names.
    """

    run: str
    problem: Problem
    description: ModelDescription
    effects: tuple[EffectDefinition, ...]
    coefficients: tuple[tuple[EstimatedValue, ...], ...]
    parameters: tuple[EstimatedValue, ...]
    known: tuple[tuple[str, Value], ...]
    notes: tuple[str, ...]
    errors: tuple[ReportedError, ...] = ()
    ranges: Mapping[str, str] = field(default_factory=dict)
    without: str = "the original at the start values"
    of_experiments: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @cached_property
    def positions(self) -> tuple[int, ...]:
        """Index of the first coefficient of each effect among those of all."""
        return tuple(np.cumsum([0, *map(len, self.coefficients)])[:-1].tolist())


def describe_repair(repair: RepairedModel) -> str:
    """All that a run has found, as plain text."""
    lines = ["Parameters", *(_line(found) for found in repair.parameters)]
    lines = lines if repair.parameters else []
    return "\n".join([*lines, *([""] if lines else []), describe_effects(repair)])


def describe_effects(repair: RepairedModel) -> str:
    """The effects: site, equation and coefficients of each."""
    if not repair.effects:
        return "No effects were added.\n"
    lines = ["Effects"]
    for effect, values in zip(repair.effects, repair.coefficients, strict=True):
        lines += [f"  {effect.effect.name} ({effect.form.name}) at {effect.site}"]
        lines += [f"    {effect_equation(effect)}"]
        prefix = f"{effect.effect.name}."
        lines += [f"  {_line(value, prefix)}" for value in values]
        if effect.effect.name in repair.ranges:
            lines += [f"    estimated over {repair.ranges[effect.effect.name]}; beyond, a guess"]
    return "\n".join(lines) + "\n"


def effect_equation(effect: EffectDefinition) -> str:
    """The equation as a person reads it."""
    if not effect.effect.equation:
        return equation_text(effect.effect, effect.form, effect.site)
    own = effect.effect
    if effect.site.other:
        first, second = effect.site.targets
        return f"der({first}) += {own.equation}, der({second}) += {own.reaction}"
    sign = "+=" if effect.site.at_rates else "->"
    left = str(effect.site) if effect.site.at_rates else effect.site.target
    return f"{left} {sign} {own.equation}"


def _line(found: EstimatedValue, prefix: str = "") -> str:
    unit = f" {found.unit}" if found.unit not in ("", "1") else ""
    interval = f"  ({found.interval})" if found.interval else ""
    return f"  {found.name.removeprefix(prefix)} = {found.value:.6g}{unit}{interval}"
