"""Descriptions of the effects that were found, in the words and numbers of a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from cluster_est.closed_loop.candidates.arguments import KinematicDefinition
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.alternatives import alternatives_of, same_law_sentence
from cluster_est.closed_loop.findings.effect_curves import (
    THRESHOLDS,
    agreements,
    missed_thresholds,
)
from cluster_est.closed_loop.findings.effects import AgreeingEquation, ErrorChange, NamedEffect
from cluster_est.closed_loop.findings.naming import EffectName, Namer
from cluster_est.closed_loop.findings.unexplained import varying_columns
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.acceptance import period_of, residuals_without
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import CandidateStage
from cluster_est.problem.display import in_a_row, in_percent, in_unit, readable_time
from cluster_est.results.fit_tables import EffectCurve, Estimate
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_shapes import shape_over
from cluster_est.results.shapes.filter_responses import dynamics_in_words
from workers.effects.laws import Law
from workers.effects.site import bracketed

WINDOWS = 20
"""Number of parts of a record, to say in which part most of its residual is."""

STANDS_OUT = 4.0
"""A part of a record is named if its share of the sum of squares is at least this many times its
share of the samples. For white noise and parts of ten samples, the largest of about a hundred parts
reaches three times."""


def shared_arguments(added: Sequence[EffectCandidate]) -> tuple[str, ...]:
    """Say which effects are functions of the same argument at the same site."""
    places: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for candidate in added:
        if candidate.effect.variables and candidate.form.variables == 1:
            place = str(candidate.site), candidate.effect.variables
            places.setdefault(place, []).append(candidate.form.name)
    return tuple(
        f"{in_a_row(names)} are functions of the same variable, {argument}, at {site}: use their "
        "sum as one curve, because the size and the name of the single terms are less certain"
        for (site, (argument,)), names in places.items()
        if len(names) > 1
    )


MOST_EQUATIONS = 4
"""Number of equations that a note shows."""


def taken_for_definitions(definitions: Sequence[KinematicDefinition]) -> tuple[str, ...]:
    """Say which equations count as definitions although no unit says so, and how to search there.

    In a mechanical model with units, such equations are obvious, so there is no note.
    """
    unsure = [each for each in definitions if not each.certain]
    if not unsure:
        return ()
    shown = [f"der({each.state}) = {each.speed}" for each in unsure[:MOST_EQUATIONS]]
    more = len(unsure) - len(shown)
    shown += [f"{more} more"] if more else []
    taken, these, state, one = (
        ("were taken for definitions of rates", "these", "its state", "one of these equations")
        if len(unsure) > 1
        else ("was taken for the definition of a rate", "this", unsure[0].state, "this equation")
    )
    derivatives = f"{these} derivative{'s' if len(unsure) > 1 else ''}"
    return (
        f"{in_a_row(shown)} {taken}, so no effect was searched at {derivatives}; "
        f"if {one} is a balance, such as that of a volume or a charge, set "
        f'closed_loop.sites = ["der({unsure[0].state})"], or the unit of {state} in model.units',
    )


def describe_effects(
    fitter: Fitter,
    found: SelectionResult,
    result: Result,
    curves: Sequence[EffectCurve] = (),
) -> tuple[NamedEffect, ...]:
    """Describe the effects of the final model, each with the alternatives that the data allow.

    `curves` are the curves of these effects, as far as they have one. A curve says for which range
    of its argument the name of the effect is right.
    """
    own = {curve.effect: curve for curve in reversed(curves)}
    namer = Namer(fitter.description, dict(fitter.problem.units))
    return tuple(
        _describe(fitter, found, candidate, result, namer, own.get(candidate.effect.name))
        for candidate in found.current.added
    )


def describe_untested(fitter: Fitter, fitted: FittedModel) -> tuple[NamedEffect, ...]:
    """Describe the effects of a model that the search refitted and did not accept."""
    namer = Namer(fitter.description, dict(fitter.problem.units))
    made = []
    for candidate in fitted.added:
        words = namer.name(candidate, fitted.coefficients(candidate), None).words
        made.append(
            NamedEffect(
                effect=candidate.effect,
                family=candidate.form.family,
                equation=candidate.equation,
                coefficients=(),
                words=words,
                sentence=sentence_of(words, candidate, (), None),
                label=candidate.label,
            )
        )
    return tuple(made)


def error_changes(
    fitter: Fitter, found: SelectionResult, before: Result, after: Result
) -> tuple[ErrorChange, ...]:
    """Return the errors of the declared model and of the final model, by experiment and output."""
    noise = fitter.noise_in_units(found.noise)
    rows = []
    for old, new in zip(before.errors, after.errors, strict=True):
        sigma = noise.get(old.output, np.nan)
        if fitter.sigma_declared:
            normalised = old.normalised_after, new.normalised_after
        else:
            normalised = _over(old.rmse_after, sigma), _over(new.rmse_after, sigma)
        rows.append(ErrorChange.between(old, new, normalised))
    return tuple(rows)


def _over(error: float, sigma: float) -> float:
    """Return an error divided by the noise; NaN if the noise is unknown or 0."""
    return error / sigma if sigma > 0.0 else np.nan


def where_left(fitter: Fitter, fitted: FittedModel) -> str:
    """Say in which part of the data most of a residual is."""
    total = fitted.sse
    if not total > 0.0:
        return "there is no remaining error"
    best: tuple[float, float, str] = (0.0, 0.0, "")
    for record in fitter.records.items:
        if not len(record.times):
            continue
        squares = fitted.residuals[record.rows] ** 2
        edges = np.linspace(record.times[0], record.times[-1], WINDOWS + 1)
        window = np.clip(np.searchsorted(edges, record.times, side="right") - 1, 0, WINDOWS - 1)
        sums = np.bincount(window, weights=squares, minlength=WINDOWS)
        k = int(np.argmax(sums))
        if sums[k] > best[0]:
            run = fitter.runs[record.experiment]
            best = (
                float(sums[k]),
                float(np.sum(window == k)) / len(fitted.residuals),
                f"output {fitter.records.outputs[record.output]} of experiment {run.id!r} "
                f"between t = {edges[k]:.4g} and {edges[k + 1]:.4g} s",
            )
    part = best[0] / total
    if part < STANDS_OUT * best[1]:
        return "the remaining error is spread evenly over all experiments"
    return (
        f"the remaining error is largest in {best[2]}: {in_percent(part)} of the squared error is "
        f"in {in_percent(best[1], 1)} of the samples"
    )


def _describe(
    fitter: Fitter,
    found: SelectionResult,
    candidate: EffectCandidate,
    result: Result,
    namer: Namer,
    curve: EffectCurve | None,
) -> NamedEffect:
    name = candidate.effect.name
    coefficients = tuple(e for e in result.estimates if e.parameter.startswith(f"{name}."))
    period = period_of(candidate, found.current)
    labels = [f"{name}.{c.name}" for c in candidate.form.coefficients]
    known = [[e.value for e in coefficients if e.parameter == label] for label in labels]
    values = [float(np.mean(own)) if own else np.nan for own in known]
    named = namer.name(candidate, values, curve, _interval(coefficients, f"{name}.n"))
    also = _agreeing(fitter, result, named, curve)
    alternatives = alternatives_of(fitter, found, candidate, namer, result)
    said = sentence_of(named.words, candidate, coefficients, curve, also, period)
    return NamedEffect(
        effect=candidate.effect,
        family=candidate.form.family,
        equation=candidate.equation,
        coefficients=coefficients,
        alternatives=alternatives,
        evidence=(
            *_evidence(found, candidate, period),
            *_columns(fitter, found, candidate, period),
            *((FEEDS_ENERGY,) if named.placed.feeds_energy else ()),
        ),
        words=named.words,
        sentence=" ".join(filter(None, [said, same_law_sentence(alternatives)])),
        also=also,
        period=float(period),
        label=candidate.label,
    )


FEEDS_ENERGY = (
    "it pushes in the direction of motion and so adds energy, which friction never does: look for "
    "a drive that the model lacks, for a wrong sign, and for a declared damping that is too large"
)


def _interval(coefficients: Sequence[Estimate], parameter: str) -> tuple[float, float] | None:
    """Return the 95 % interval of a coefficient; None if the data do not determine it."""
    ends = [(e.lower95, e.upper95) for e in coefficients if e.parameter == parameter]
    return ends[0] if len(ends) == 1 and all(map(math.isfinite, ends[0])) else None


def _agreeing(
    fitter: Fitter,
    result: Result,
    named: EffectName,
    curve: EffectCurve | None,
) -> tuple[AgreeingEquation, ...]:
    """Return the equations that agree with an effect on the range of the data."""
    shape = None if curve is None else shape_over(curve, result, fitter.description)
    if curve is None or shape is None:
        return ()
    return agreements(curve, shape, named.placed.law, named.of_law)


def _columns(
    fitter: Fitter, found: SelectionResult, candidate: EffectCandidate, period: float
) -> tuple[str, ...]:
    """Sentences on unused columns that may be the true cause of a wave in time."""
    if not np.isfinite(period):
        return ()
    without = residuals_without(found.current, candidate)
    return tuple(
        column.sentence
        for column in varying_columns(fitter, without, found.settings.significance, period)
    )


def _evidence(found: SelectionResult, candidate: EffectCandidate, period: float) -> tuple[str, ...]:
    """Sentences on the reasons for an effect, and on its assumptions."""
    sentences = []
    if np.isfinite(period):
        sentences.append(
            f"a sinusoid in time with a period of {readable_time(period)} and the same phase in "
            "all experiments: this is right only if the times of all experiments come from one "
            "clock; if a measured quantity oscillates with this period, declare that quantity as a "
            "signal"
        )
    accepted = [f for f in found.findings if f.stage is CandidateStage.ACCEPTED]
    for finding in found.findings:
        own = (finding.site, finding.form, finding.variables)
        if own != (str(candidate.site), candidate.form.name, candidate.effect.variables):
            continue
        if finding.stage is CandidateStage.ACCEPTED:
            several = sum(f.step == finding.step for f in accepted) > 1
            fall = "with all effects of this step together, the" if several else "the"
            sentences.append(
                f"step {finding.step}: explains {in_percent(finding.explained)} of the residual; "
                f"{fall} criterion falls by {-finding.criterion:.0f}"
            )
    return tuple(sentences)


ROUNDING = 1e-6
"""If a difference is below this share of an effect, it counts as rounding."""


def sentence_of(
    words: str,
    candidate: EffectCandidate,
    coefficients: Sequence[Estimate],
    curve: EffectCurve | None,
    also: Sequence[AgreeingEquation] = (),
    period: float = math.nan,
) -> str:
    """Describe an effect that was found, in one or two sentences."""
    said = f"{words[:1].upper()}{words[1:]} {_place(candidate)}: {candidate.equation}"
    values = [_value(candidate, e) for e in coefficients if e.label == e.parameter]
    values += [
        f"a value of {c.name} for each experiment" for c in candidate.form.coefficients if c.each
    ]
    values = [] if candidate.form.free else values
    if candidate.form.is_dynamics:
        found = {e.parameter.rpartition(".")[2]: e.value for e in coefficients}
        known = [found.get(c.name, math.nan) for c in candidate.form.coefficients]
        done = dynamics_in_words(candidate.form, known)
        said += "; no known form" + (f": {done}" if done else "")
    if values:
        said += f", with {in_a_row(values)}"
    if math.isfinite(period):
        said += f", a period of {readable_time(period)}"
    said += _repeats(candidate, coefficients, curve)
    said += _reference(candidate, coefficients)
    seen = curve if curve is not None and len(curve.x) and curve.variable != "time" else None
    seen = None if candidate.form.is_dynamics else seen
    if seen is not None:
        own = candidate.site.kind == "output" and seen.variable == candidate.site.target
        said += f"; {'without the effect' if own else 'in the data'}, {_range(seen)}"
        said += _not_reached(candidate, coefficients, seen)
    return " ".join([f"{said}.", *(_agreement(each, seen) for each in also if seen is not None)])


REFERENCES = {
    "drift": "t", "linear": "{v}", "inverse": "{v}", "exponential": "{v}", "power": "abs({v})",
    "offset_power": "abs({v})", "magnitude": "abs({v})", "square": "{v}^2",
    "inverse_square": "{v}^2", "arrhenius": "{v}", "heating": "z", "lagged": "z",
    "delayed": "the delayed {v}",
}  # fmt: skip
"""By form that leaves a parameter unchanged at one value of its argument, `at`: this argument."""


def _reference(candidate: EffectCandidate, coefficients: Sequence[Estimate]) -> str:
    """Say for which argument a parameter that now varies has its estimated value."""
    if candidate.site.kind != "parameter":
        return ""
    known = {e.parameter.removeprefix(f"{candidate.effect.name}."): e for e in coefficients}
    ends = [
        known[name]
        for name in (("low", "high") if candidate.form.free else ("at",))
        if name in known
    ]  # a free curve is zero in the middle of its range
    argument = "{v}" if candidate.form.free else REFERENCES.get(candidate.form.name)
    if argument is None or not ends:
        return ""
    variable = next(iter(candidate.effect.variables), "")
    named = argument.format(v=bracketed(variable) if "^" in argument else variable)
    value = sum(each.value for each in ends) / len(ends)
    where = f"{named} = {value:.4g}{in_unit(ends[0].unit)}"
    return f"; the estimate of {candidate.site.target} is its value at {where}"


def _repeats(
    candidate: EffectCandidate, coefficients: Sequence[Estimate], curve: EffectCurve | None
) -> str:
    """Say over which distance a term repeats that is periodic in its argument."""
    law = candidate.form.law
    n = next((e.value for e in coefficients if e.parameter == f"{candidate.effect.name}.n"), 0.0)
    if law not in (Law.PERIODIC, Law.PERIODIC_ERROR) or not n > 0.0:
        return ""
    unit = in_unit(curve.variable_unit) if curve is not None else ""
    return f", a period of {2.0 * math.pi / n:.4g}{unit}"


def _not_reached(
    candidate: EffectCandidate, coefficients: Sequence[Estimate], curve: EffectCurve
) -> str:
    """Say which thresholds of a law the data do not reach."""
    name = candidate.effect.name
    known = {e.parameter.removeprefix(f"{name}."): e.value for e in coefficients}
    law, unit = candidate.form.law, in_unit(curve.variable_unit)
    missed = missed_thresholds(law, known, curve)
    if not missed:
        return ""
    at = in_a_row([f"{curve.variable} = {each:.4g}{unit}" for each in missed])
    if THRESHOLDS[law][1]:
        return f"; the data do not reach {at}, so they do not show what happens there"
    return f"; the data do not pass {at}, so they do not show that there is such a threshold"


def _place(candidate: EffectCandidate) -> str:
    site = candidate.site
    return f"between {' and '.join(site.targets)}" if site.kind == "pair" else f"at {site}"


def _value(candidate: EffectCandidate, estimate: Estimate) -> str:
    name = estimate.parameter.removeprefix(f"{candidate.effect.name}.")
    value, low, high = estimate.value, estimate.lower95, estimate.upper95
    long = estimate.unit == "s" and abs(value) > LONG_TIME
    number: Callable[[float], str] = readable_time if long else f"{{:.{_digits(estimate)}g}}".format
    said = f"{name} = {number(value)}{'' if long else in_unit(estimate.unit)}"
    if estimate.estimated_on == "known":
        return f"{said} (fixed)"
    if estimate.at_bound:
        return f"{said} (at its {estimate.at_bound} bound)"
    if math.isfinite(low) and math.isfinite(high):
        return f"{said} ({number(low)} to {number(high)})"
    return f"{said} (not determined)"


def _digits(estimate: Estimate) -> int:
    """Return the significant digits with which an interval shows two digits of its half width."""
    half = 0.5 * (estimate.upper95 - estimate.lower95)
    if not (math.isfinite(half) and half > 0.0 and estimate.value):
        return FEWEST_DIGITS
    shown = math.floor(math.log10(abs(estimate.value))) - math.floor(math.log10(half)) + 2
    return min(max(shown, FEWEST_DIGITS), MOST_DIGITS)


FEWEST_DIGITS, MOST_DIGITS = 4, 8
"""Smallest and largest number of significant digits of a value with an interval."""


LONG_TIME = 120.0
"""Times above this number of seconds are written in minutes, hours or days."""


def _range(curve: EffectCurve) -> str:
    low, high = float(curve.x[0]), float(curve.x[-1])
    digits = 2 - math.floor(math.log10(high - low)) if high > low else 6
    ends = [f"{round(end, digits) + 0.0:.6g}" for end in (low, high)]
    return f"{curve.variable} is between {' and '.join(ends)}{in_unit(curve.variable_unit)}"


def _agreement(also: AgreeingEquation, curve: EffectCurve) -> str:
    """Name an equation with nearly the same values, and where to measure to distinguish the two."""
    named = f"{also.equation} ({also.words})" if also.words else also.equation
    unit, over = in_unit(curve.unit), in_unit(curve.variable_unit)
    off = f"differs by at most {also.difference:.2g}{unit} ({in_percent(also.share, 1)}) from"
    return (
        f"Over that range, it {off if also.share > ROUNDING else 'equals'} {named}. At "
        f"{curve.variable} = {also.told_at:.3g}{over}, the two would differ by "
        f"{also.told_by:.2g}{unit}, so measure there to distinguish them."
    )


LIKE_RAMPS = ("delay", "lag", "lag_from_rest", "rate_limit")
"""Forms at an input that linear interpolation of jumps can imitate."""


def is_like_ramp(candidate: EffectCandidate) -> bool:
    """Return whether linear interpolation of an input that jumps can imitate an effect."""
    return candidate.site.kind == "input" and candidate.form.name in LIKE_RAMPS


def inputs_like_ramps(added: Sequence[EffectCandidate]) -> tuple[str, ...]:
    """Return the inputs with such an effect."""
    return tuple(c.site.target for c in added if is_like_ramp(c))
