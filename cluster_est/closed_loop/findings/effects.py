"""The findings of a search: verdict, effects, their config blocks, and errors."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from cluster_est.closed_loop.findings.claims import Claim
from cluster_est.problem.display import in_sentences
from cluster_est.problem.parameter import Parameter
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.output_errors import OutputError
from cluster_est.toml import dotted, inline
from workers.messages import Effect, Role


class Verdict(enum.StrEnum):
    """The verdict of a search for missing effects, with its text in run.json."""

    NONE = "none"
    COLOURED = "none (coloured noise)"
    FOUND = "found"
    PARTIAL = "partial"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class AlternativeEffect:
    """An effect that these data cannot distinguish from the chosen effect.

    Attributes
    ----------
    site, form, family, variables, equation
        Properties of the effect. The equation is "" if its own states only approximate a delay.
    criterion
        Information criterion, minus that of the chosen effect (negative: better). This and the
        numbers below are of the final model; NaN if the effect was not fitted in this model.
    experiment, output, time
        Sample at which its predictions differ most from those of the chosen effect.
    difference
        Difference of the two predictions there, in standard deviations of the noise.
    words
        Its name in physics or mathematics.
    parameters
        Values of declared parameters with it, outside of their intervals with the chosen effect.
    nested
        Whether it is the chosen law with a delay or a lag that is too short to be seen.
    same_law
        Whether it is the chosen law, written in another way: a function of the same arguments with
        the same predictions.
    unknowns
        Number of unknowns of the model with it, minus that of the model with the chosen effect.
    better
        Whether it fits better than the chosen effect, together with the other effects.
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
    parameters: str = ""
    nested: bool = False
    same_law: bool = False
    unknowns: int = 0
    better: bool = False


@dataclass(frozen=True)
class AgreeingEquation:
    """Another equation that agrees with the equation of an effect on the range of the data.

    Attributes
    ----------
    equation
        The term that it would add instead, such as "-0.35 * v * abs(v)".
    words
        Its name in physics; "" if the units do not determine one.
    difference, share
        Largest difference on the data, in the unit of the effect, and as a share of the effect's
        largest size.
    told_at, told_by
        The value nearest to the data at which the two equations clearly differ, and their
        difference there. An experiment at this value would distinguish them.
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
        The effect, as a config would declare it.
    family, equation
        For example "friction" and "der(v) += -k * tanh(v / width)".
    coefficients
        Its estimated numbers, with intervals and units.
    alternatives
        Effects that the data cannot distinguish from it.
    evidence
        Sentences on the evidence for it.
    words, sentence
        Its name in physics, or in mathematics if the units do not determine one; and the finding as
        a sentence with numbers.
    also
        Equations that agree with it on the range of the data.
    period
        Period in seconds of a sinusoid in time; NaN for other effects.
    label
        The name of the effect in structures, such as "coulomb at der(v)".
    claim
        How sure it is that the effect is right; None if this was not computed.
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
    label: str = ""
    claim: Claim | None = None

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def claimed(self) -> bool:
        """Return whether the effect is more likely right than wrong; otherwise it is a lead."""
        return self.claim is None or self.claim.claimed

    @property
    def site(self) -> str:
        return self.effect.site

    @property
    def form(self) -> str:
        return self.effect.form

    @property
    def variables(self) -> tuple[str, ...]:
        return self.effect.variables

    def coefficient(self, estimate: Estimate) -> str:
        """Return the label of a coefficient without the effect's name, as "k", or "a[exp5]"."""
        return estimate.label.removeprefix(f"{self.name}.")


@dataclass(frozen=True)
class NoiseChange:
    """The strength of process noise, fitted with the declared model and with the added effects.

    Attributes
    ----------
    name, site, unit
        Name and site of the noise; unit of its strength.
    before, after
        Standard deviation of an Ornstein-Uhlenbeck process, or q of white noise.
    time_before, time_after
        Time constant tau of an Ornstein-Uhlenbeck process, in seconds; NaN for white noise.
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
        """Whether the noise is an Ornstein-Uhlenbeck process."""
        return bool(np.isfinite(self.time_before))

    @property
    def variance_left(self) -> float:
        """Variance of the noise with the effects, divided by the variance without them."""
        return (self.after / self.before) ** 2 if self.before > 0.0 else np.nan


@dataclass(frozen=True)
class ErrorChange:
    """The errors of an output of an experiment, before and after.

    `rmse` is in the output's unit. `normalised` is divided by the given sigma, or by the estimated
    noise if no sigma is given.
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

    @property
    def unchanged(self) -> ErrorChange:
        """The same errors before and after, because nothing was added."""
        before, normalised = self.rmse_before, self.normalised_before
        return replace(self, rmse_after=before, normalised_after=normalised)

    @classmethod
    def between(
        cls, before: OutputError, after: OutputError, normalised: tuple[float, float]
    ) -> Self:
        """Combine the errors of two fits; `normalised` are the errors divided by sigma."""
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


ROLES: tuple[Role, ...] = ("train", "test")


def what_is_left(errors: Sequence[ErrorChange], over: str = "the noise", remark: str = "") -> str:
    """Compare the remaining error with the noise, and name outputs whose noise is not known.

    `remark` is appended to the sizes.
    """
    train, test = (largest_error(errors, role) for role in ("train", "test"))
    said = []
    several = len({e.output for e in errors}) > 1
    worst = {role: _worst_output(errors, role) if several else "" for role in ROLES}
    one = len({output for output in worst.values() if output}) == 1
    of = " of the worst output" if several else ""
    of += f", {worst['train'] or worst['test']}," if several and one else ""
    at = {role: f" ({output})" if output and not one else "" for role, output in worst.items()}
    if np.isfinite(train) and np.isfinite(test):
        said.append(
            f"the remaining error{of} is {_times(train)} times {over} on training data"
            f"{at['train']} and {_times(test)} times on held-out data{at['test']}{remark}"
        )
    elif np.isfinite(train) or np.isfinite(test):
        where = "" if np.isfinite(train) else " on held-out data"
        size = f"{_times(train if not where else test)} times {over}{where}"
        said.append(f"the remaining error{of} is {size}{remark}")
    silent = without_noise(errors)
    if silent:
        said.append(
            f"the error of {', '.join(silent)} was not compared with the noise, because that noise "
            "is not known"
        )
    for role, kind in (("train", "training"), ("test", "held-out")):
        failed = not_simulated([e for e in errors if e.role == role])
        if failed:
            said.append(f"{kind} experiment {', '.join(failed)} could not be simulated")
    return in_sentences(said)


def _worst_output(errors: Sequence[ErrorChange], role: Role) -> str:
    """Return the output with the largest error over its noise; "" if no error is known."""
    sizes = _errors_by_output(errors, role)
    return max(sizes, key=lambda output: sizes[output]) if sizes else ""


def _times(size: float) -> str:
    """Write a multiple, with two decimals if it is small."""
    return f"{size:.2f}" if size < 10.0 else f"{size:.3g}"


def not_simulated(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Return the experiments with data that could not be simulated with the effects."""
    rows = [e for e in errors if e.samples and not np.isfinite(e.rmse_after)]
    return tuple(dict.fromkeys(repr(e.experiment) for e in rows))


def no_longer_simulated(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Return the experiments that can be simulated without the effects, but not with them."""
    return not_simulated([e for e in errors if np.isfinite(e.rmse_before)])


def without_noise(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Return the outputs with an error, but without a known noise."""
    rows = [e for e in errors if e.rmse_after > 0.0 and not np.isfinite(e.normalised_after)]
    return tuple(dict.fromkeys(e.output for e in rows))


def over_noise(
    errors: Sequence[ErrorChange], noise: Mapping[str, float]
) -> tuple[ErrorChange, ...]:
    """Return the errors divided by a noise, which is given by output in units of sigma."""
    return tuple(
        replace(
            e,
            normalised_before=e.normalised_before / noise.get(e.output, 1.0),
            normalised_after=e.normalised_after / noise.get(e.output, 1.0),
        )
        for e in errors
    )


def comparable(errors: Sequence[ErrorChange]) -> tuple[ErrorChange, ...]:
    """Return the errors that are known both before and after."""
    return tuple(
        e for e in errors if np.isfinite(e.normalised_before) and np.isfinite(e.normalised_after)
    )


def largest_error(errors: Sequence[ErrorChange], role: Role) -> float:
    """Return the largest error of an output with the effects, over its noise; NaN without any."""
    return max(_errors_by_output(errors, role).values(), default=np.nan)


def _errors_by_output(errors: Sequence[ErrorChange], role: Role) -> dict[str, float]:
    """Return the known errors with the effects, over their noise, by output."""
    outputs = dict.fromkeys(e.output for e in errors if e.role == role)
    sizes = {
        output: pooled_error([e for e in errors if e.output == output], role, after=True)
        for output in outputs
    }
    return {output: size for output, size in sizes.items() if np.isfinite(size)}


def pooled_error(errors: Sequence[ErrorChange], role: Role, *, after: bool) -> float:
    """Return the root mean square of the errors over their noise; NaN if there are none."""
    rows = [e for e in errors if e.role == role]
    values = np.array([e.normalised_after if after else e.normalised_before for e in rows])
    samples = np.array([e.samples for e in rows], float)
    known = np.isfinite(values)
    if not known.any():
        return np.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=samples[known])))


def config_block(effect: NamedEffect) -> str:
    """Return an entry of `[[effects]]` that starts from the estimated values.

    The bounds are those of the search, so a fit with this entry finds the same values.
    """
    neutral, sections = dict(effect.effect.coefficients), {}
    for estimate in effect.coefficients:
        name = estimate.parameter.removeprefix(f"{effect.name}.")
        fixed = estimate.estimated_on == "known"
        bounds = () if fixed else (estimate.lower, estimate.upper)
        section = _section(estimate.value, neutral.get(name), bounds, estimate.scale, fixed=fixed)
        section |= {"per": "experiment"} if estimate.label != estimate.parameter else {}
        sections[name] = section | ({"unit": estimate.unit} if estimate.unit else {})
    return _block(effect.effect, sections)


def effect_block(effect: Effect, coefficients: Sequence[Parameter]) -> str:
    """Return an entry of `[[effects]]` for an effect with these parameters as coefficients."""
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
) -> dict[str, Any]:
    section: dict[str, Any] = {"start": float(start), "neutral": neutral}
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
