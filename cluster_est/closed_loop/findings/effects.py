"""The findings of a closed loop: verdict, effects, their curves, errors before and after."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from cluster_est.results.row_types import Estimate
from workers.messages import Effect, Role


class Verdict(enum.StrEnum):
    """The verdict of a closed loop. A member's text is what run.json carries."""

    NONE = "none"
    COLOURED = "none (coloured noise)"
    FOUND = "found"
    PARTIAL = "partial"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class AlternativeEffect:
    """An effect that cannot be told apart from the one chosen on this data.

    Attributes
    ----------
    site, form, family, variables, equation
        Of the effect.
    criterion
        Of information, less that of the chosen effect (negative: better).
    experiment, output, time
        At which its predictions differ most from those of the chosen effect.
    difference
        Of the predictions there, in standard deviations of the noise.
    """

    site: str
    form: str
    family: str
    variables: tuple[str, ...]
    equation: str
    criterion: float
    experiment: str = ""
    output: str = ""
    time: float = np.nan
    difference: float = np.nan


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was added to the model.

    Attributes
    ----------
    effect
        As it can be written into a config.
    family, equation
        "friction", "der(v) += -k * tanh(v / width)".
    coefficients
        Its estimated numbers, with intervals and units.
    alternatives
        Effects that it cannot be told apart from.
    evidence
        Sentences.
    """

    effect: Effect
    family: str
    equation: str
    coefficients: tuple[Estimate, ...]
    alternatives: tuple[AlternativeEffect, ...] = ()
    evidence: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def site(self) -> str:
        return self.effect.site

    @property
    def form(self) -> str:
        return self.effect.form

    @property
    def variables(self) -> tuple[str, ...]:
        return self.effect.variables


@dataclass(frozen=True)
class ErrorChange:
    """The errors of an output of an experiment, before and after.

    `rmse` is in the output's unit, `normalised` over sigma (the given one, else the estimated
    noise).
    """

    experiment: str
    role: Role
    output: str
    unit: str
    samples: int
    rmse_before: float
    rmse_after: float
    normalised_before: float
    normalised_after: float
