"""A finding as one would say it, with its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.effects import AgreeingEquation
from cluster_est.closed_loop.findings.words.numbers import in_a_row, readable_time
from cluster_est.results.fit_tables import EffectCurve, Estimate

SAME = 1e-6
"""Share of an effect below which a difference is that of rounding."""


def sentence_of(
    words: str,
    candidate: EffectCandidate,
    coefficients: Sequence[Estimate],
    curve: EffectCurve | None,
    also: Sequence[AgreeingEquation] = (),
    period: float = math.nan,
) -> str:
    """Return what was found in a sentence or two.

    Parameters
    ----------
    words
        Its name.
    candidate, coefficients
        The effect, and its numbers.
    curve
        Of the effect; None where it has none.
    also
        Equations that agree with it where the data were.
    period
        Of a wave in time; else NaN.
    """
    said = f"{_capital(words)} {_place(candidate)}: {candidate.equation}"
    values = [] if candidate.form.free else [_value(candidate, e) for e in coefficients if _told(e)]
    if values:
        said += f", with {in_a_row(values)}"
    if math.isfinite(period):
        said += f", a period of {readable_time(period)}"
    said += _reference(candidate, coefficients)
    seen = curve if curve is not None and len(curve.x) and curve.variable != "time" else None
    if seen is not None:
        own = candidate.site.kind == "output" and seen.variable == candidate.site.target
        said += f"; {'before the effect' if own else 'in the data'} {_range(seen)}"
    return " ".join([f"{said}.", *(_agreement(each, seen) for each in also if seen is not None)])


REFERENCES = {
    "drift": "t", "linear": "{v}", "inverse": "{v}", "exponential": "{v}", "power": "abs({v})",
    "magnitude": "abs({v})", "square": "{v}^2", "inverse_square": "{v}^2", "heating": "z",
}  # fmt: skip
"""Of forms at a parameter that leave it as it is at one value of their argument: that argument."""


def _reference(candidate: EffectCandidate, coefficients: Sequence[Estimate]) -> str:
    """Say where a parameter that varies now has the value that is estimated for it."""
    argument = REFERENCES.get(candidate.form.name)
    at = next((e for e in coefficients if e.parameter == f"{candidate.effect.name}.at"), None)
    if candidate.site.kind != "parameter" or argument is None or at is None:
        return ""
    named = argument.format(v=next(iter(candidate.effect.variables), ""))
    where = f"{named} = {at.value:.4g}{in_unit(at.unit)}"
    return f"; the value of {candidate.site.target} is the one at {where}"


def _place(candidate: EffectCandidate) -> str:
    site = candidate.site
    return f"between {' and '.join(site.targets)}" if site.kind == "pair" else f"at {site}"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def _told(estimate: Estimate) -> bool:
    """A width that was held is nobody's finding."""
    return estimate.estimated_on != "known"


def _value(candidate: EffectCandidate, estimate: Estimate) -> str:
    name = estimate.parameter.removeprefix(f"{candidate.effect.name}.")
    said = f"{name} = {estimate.value:.4g}{in_unit(estimate.unit)}"
    if estimate.at_bound:
        return f"{said} (at its {estimate.at_bound} bound)"
    if math.isfinite(estimate.lower95) and math.isfinite(estimate.upper95):
        return f"{said} ({estimate.lower95:.4g} to {estimate.upper95:.4g})"
    return f"{said} (not determined)"


def in_unit(unit: str) -> str:
    """Return a unit behind a number; "" where it is a number's, or not known."""
    return "" if unit in ("", "1") or "?" in unit else f" {unit}"


def _range(curve: EffectCurve) -> str:
    low, high = float(curve.x[0]), float(curve.x[-1])
    return f"{curve.variable} went from {low:.3g} to {high:.3g}{in_unit(curve.variable_unit)}"


def _agreement(also: AgreeingEquation, curve: EffectCurve) -> str:
    """What else the equation may be, and where to measure to tell."""
    named = f"{also.equation} ({also.words})" if also.words else also.equation
    unit, over = in_unit(curve.unit), in_unit(curve.variable_unit)
    off = f", but for {also.difference:.2g}{unit} ({also.share:.1%}), "
    return (
        f"On that range it is{off if also.share > SAME else ' '}also {named}: at "
        f"{curve.variable} = {also.told_at:.3g}{over} the two would differ by "
        f"{also.told_by:.2g}{unit}, so measure there to tell them apart."
    )
