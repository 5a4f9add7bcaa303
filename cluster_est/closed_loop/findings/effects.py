"""The findings of a closed loop: verdict, effects, their curves, errors before and after."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Self

import numpy as np

from cluster_est.results.fit_tables import Estimate
from cluster_est.results.output_errors import OutputError
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
    words
        Its name in the words of physics or mathematics.
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
    words: str = ""


@dataclass(frozen=True)
class AgreeingEquation:
    """Another equation that agrees with that of an effect wherever the data were.

    Attributes
    ----------
    equation
        What it would add instead: "-0.35 * v * abs(v)".
    words
        Its name in physics; "" where the units do not say.
    difference, share
        The largest difference in the data, in the unit of the effect, and over its largest size.
    told_at, told_by
        The value of the variable nearest to the data at which the two clearly differ, and by how
        much: there an experiment would tell them apart.
    """

    equation: str
    words: str
    difference: float
    share: float
    told_at: float
    told_by: float


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
    words, sentence
        Its name in the words of physics, or of mathematics where units do not say; and the finding
        as one would say it, with numbers.
    also
        Equations that agree with it on the range of the data.
    period
        Seconds, of a wave in time; NaN for what is none.
    """

    effect: Effect
    family: str
    equation: str
    coefficients: tuple[Estimate, ...]
    alternatives: tuple[AlternativeEffect, ...] = ()
    evidence: tuple[str, ...] = ()
    words: str = ""
    sentence: str = ""
    also: tuple[AgreeingEquation, ...] = ()
    period: float = np.nan

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
class NoiseChange:
    """The strength of process noise in fits of the declared model, and of that with the effects.

    Attributes
    ----------
    name, site, unit
        Of the noise; the unit of its strength.
    before, after
        Standard deviation of an Ornstein-Uhlenbeck process; of white noise its q.
    time_before, time_after
        Seconds that a push lasts, tau; NaN of white noise.
    """

    name: str
    site: str
    unit: str
    before: float
    after: float
    time_before: float = np.nan
    time_after: float = np.nan

    @property
    def coloured(self) -> bool:
        """It is an Ornstein-Uhlenbeck process."""
        return bool(np.isfinite(self.time_before))

    @property
    def variance_left(self) -> float:
        """Share of its variance that the effects leave."""
        return (self.after / self.before) ** 2 if self.before > 0.0 else np.nan


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

    @classmethod
    def between(
        cls, before: OutputError, after: OutputError, normalised: tuple[float, float]
    ) -> Self:
        """Put the errors of two fits side by side; `normalised` are those over sigma."""
        return cls(
            experiment=before.experiment,
            role=before.role,
            output=before.output,
            unit=before.unit,
            samples=before.samples,
            rmse_before=before.rmse_after,
            rmse_after=after.rmse_after,
            normalised_before=normalised[0],
            normalised_after=normalised[1],
        )
