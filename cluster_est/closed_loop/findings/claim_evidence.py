"""The evidence for each effect of a set, and doubts that the last fit raises.

The evidence comes from the structures that a search compared. Doubts are reported, and with a doubt
the verdict is not "found". There are three kinds of doubt. If a declared parameter is at a bound,
an effect may compensate for a value beyond this bound. If a coefficient of a law is at the end of
its range, the law behaves like a part of another law: saturation with a knee far beyond the data is
a line. If a fit ended far from its minimum, its intervals cannot be used to judge an effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.claims import CLAIMED, ClaimEvidence, claim, lead
from cluster_est.closed_loop.findings.effects import (
    AlternativeEffect,
    ErrorChange,
    NamedEffect,
    Verdict,
    comparable,
    largest_error,
    pooled_error,
)
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.problem.display import in_a_row, in_sentences, percent, plain_number
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.result import Result
from workers.effects.forms import FORMS
from workers.effects.kinds import FREE_FAMILIES
from workers.effects.site import parse_site
from workers.messages import Role

DECLARED = "the declared model"

MOST_NAMED = 3
"""Largest number of alternatives that the sentence on a lead names."""


def with_claims(
    effects: Sequence[NamedEffect],
    errors: Sequence[ErrorChange],
    structures: Sequence[ComparedStructure],
    *,
    declared: bool,
    claimed: bool,
) -> tuple[NamedEffect, ...]:
    """Add to each effect of a set its evidence, and how sure it is.

    Parameters
    ----------
    effects
        All effects of the set, in the order in which they were added.
    errors
        Errors before, and with all effects.
    structures
        All structures that were compared.
    declared
        Whether the noise is declared. An estimated noise is that of all training experiments
        together, but experiments may differ in their noise. So without a declared noise, held-out
        errors are compared with the training experiment that has the largest error.
    claimed
        Whether the effects are claimed. Otherwise they are leads.

    Returns
    -------
    tuple[NamedEffect, ...]
        The same effects, unchanged if no noise is known.
    """
    known = comparable(errors)
    role: Role = "test" if any(each.role == "test" for each in known) else "train"
    before, after = (pooled_error(known, role, after=a) ** 2 for a in (False, True))
    noisiest = 1.0
    if not declared:
        noisiest = max([1.0, *(e.normalised_after for e in known if e.role == "train")])
    left = np.array([largest_error(known, "train"), largest_error(known, "test") / noisiest])
    if np.isnan(left).all():  # no noise is known that an error could be compared with
        return tuple(effects)
    places = [(effect.site, effect.variables) for effect in effects]
    found = []
    for effect in effects:
        rival, chosen = _beside(effect, structures)
        evidence = ClaimEvidence(
            effects=len(effects),
            shared=places.count((effect.site, effect.variables)) > 1,
            left=float(np.nanmax(left)),
            closed=float((before - after) / max(before - 1.0, 1e-12)),
            rival=rival,
            chosen=chosen,
            at_end=any(each.at_bound for each in effect.coefficients) or _may_be_zero(effect),
            free=effect.family in FREE_FAMILIES,
        )
        found.append(replace(effect, claim=(claim if claimed else lead)(evidence)))
    return tuple(found)


def _may_be_zero(effect: NamedEffect) -> bool:
    """Return whether the strengths have values by experiment, and no interval excludes zero.

    Other strengths are tested before an effect is an answer (see `selection.answer`).
    """
    form = FORMS.get((parse_site(effect.site, effect.name).kind, effect.form))
    known = () if form is None else form.coefficients
    strengths = [f"{effect.name}.{c.name}" for c in known if c.neutral == 0.0]
    own = [e for e in effect.coefficients if e.parameter in strengths and e.estimated_on == "train"]
    excluded = any(e.lower95 > 0.0 or e.upper95 < 0.0 for e in own)
    return any(e.label != e.parameter for e in own) and not excluded


def how_sure(effects: Sequence[NamedEffect], *, claimed: bool) -> str:
    """Say how sure each effect is, or that it is a lead; "" if that is not known."""
    known = [(effect.label, effect.claim) for effect in effects if effect.claim is not None]
    if not known:
        return ""
    if not claimed:
        guess = in_a_row([_explained(effect) for effect in effects if effect.claim is not None])
        each_of = "for each effect, " if len(known) > 1 else ""
        others = [f"{each.words} at {each.site}" for e in effects for each in elsewhere(e)]
        it = "them" if len(known) > 1 else "it"
        instead = f"; the data do not distinguish {it} from {in_a_row(others)}" if others else ""
        return f"best guess: {guess}: {each_of}{known[0][1].sentence}{instead}"
    said = [
        f"{label} {percent(own.probability)}{' (its place)' if own.evidence.free else ''}"
        for label, own in known
    ]
    text = f"probability that place and law are right: {in_a_row(said)}"
    leads = [label for label, own in known if not own.claimed]
    if not leads:
        return text
    it = "it" if len(leads) == 1 else "them"
    return (
        f"{text}. Below {percent(CLAIMED)}, an effect is only a lead: check {in_a_row(leads)} by a "
        f"test or an inspection before you rely on {it}"
    )


def without_claims(judged: ReasonedVerdict, effects: Sequence[NamedEffect]) -> ReasonedVerdict:
    """Lower a verdict "found" to "partial" if each effect of the set is only a lead.

    Such effects follow the data, but this does not say that they are what is missing.
    """
    leads_only = effects and not any(effect.claimed for effect in effects)
    if judged.verdict is not Verdict.FOUND or not leads_only:
        return judged
    said = (
        "the effect follows the data, but it is more likely wrong than right"
        if len(effects) == 1
        else "the effects follow the data, but none of them is more likely right than wrong"
    )
    reason = in_sentences([judged.reason, said])
    return replace(judged, verdict=Verdict.PARTIAL, reason=reason)


def _explained(effect: NamedEffect) -> str:
    """Return the label of an effect, with its words and its equation."""
    meaning = ": ".join(filter(None, (effect.words, effect.equation)))
    return f"{effect.label} ({meaning})" if meaning else effect.label


def elsewhere(effect: NamedEffect) -> list[AlternativeEffect]:
    """Return an effect's best alternative at each other site, for the best few sites."""
    found: dict[str, AlternativeEffect] = {}
    known = [each for each in effect.alternatives if np.isfinite(each.criterion)]
    unknown = [each for each in effect.alternatives if not np.isfinite(each.criterion)]
    for other in (*sorted(known, key=lambda each: each.criterion), *unknown):
        if other.site != effect.site:
            found.setdefault(other.site, other)
    return list(found.values())[:MOST_NAMED]


def _beside(effect: NamedEffect, structures: Sequence[ComparedStructure]) -> tuple[float, float]:
    """Return how much worse the criterion is without an effect, and its share of resamplings."""
    with_it = [row for row in structures if effect.label in row.effects]
    without = [row for row in structures if effect.label not in row.effects]
    best = min((row.criterion for row in with_it), default=np.nan)
    second = min([0.0, *(row.criterion for row in without)])
    others = [other.criterion for other in effect.alternatives if np.isfinite(other.criterion)]
    rival = min([second - best, *others])
    chosen = [row.chosen for row in with_it if np.isfinite(row.chosen)]
    return float(rival), float(sum(chosen)) if chosen else np.nan


def doubted(
    judged: ReasonedVerdict, added: Mapping[str, str], before: Result, after: Result
) -> tuple[ReasonedVerdict, tuple[str, ...]]:
    """Report the doubts that the last fit raises, and lower a verdict "found" to "partial".

    Parameters
    ----------
    judged
        The verdict so far.
    added
        Labels of the claimed effects, by name. Without any, the verdict stays as it is.
    before, after
        Last fits of the declared model and of the model with the effects.

    Returns
    -------
    ReasonedVerdict, sentences
        The verdict, and the doubts that its reason does not contain.
    """
    fits = {DECLARED: before}
    if added:
        fits["the model with the effects"] = after
    slow = {model: _not_converged(model, fit) for model, fit in fits.items() if not fit.success}
    if not added:
        return judged, tuple(slow.values())
    far = [] if _at_its_minimum(after) else [slow["the model with the effects"]]
    said = (*_at_bounds(added, after), *far)
    told: tuple[str, ...] = ()
    if said and judged.verdict is Verdict.FOUND:
        reason = in_sentences([judged.reason, *said])
        judged, told = replace(judged, verdict=Verdict.PARTIAL, reason=reason), said
    doubts = dict.fromkeys([*slow.values(), *said])
    return judged, tuple(each for each in doubts if each not in told)


def _at_bounds(added: Mapping[str, str], after: Result) -> list[str]:
    """Say which declared parameters and which coefficients of effects are at a bound."""
    names = tuple(f"{name}." for name in added)
    at_bound = [each for each in after.estimates if each.at_bound]
    own = [
        _held(each, f"{each.label.removeprefix(f'{name}.')} of {label}")
        for each in at_bound
        for name, label in added.items()
        if each.label.startswith(f"{name}.")
    ]
    declared = [_held(each, each.label) for each in at_bound if not each.label.startswith(names)]
    said = []
    if declared:
        said.append(
            f"the fit with the effects ends with {in_a_row(declared)}: an effect may compensate "
            "for a value that the bound excludes, so widen the bound unless it is a physical limit"
        )
    if own:  # a saturation whose limit is far above the data is a straight line, for example
        said.append(
            f"the fit ends with {in_a_row(own)}. At a bound, another kind of effect may fit "
            "equally well, so the kind of this effect is uncertain; compare it with the other sets "
            "of effects in structures.parquet"
        )
    return said


def _at_its_minimum(fit: Result) -> bool:
    """Return whether the data cannot distinguish the last point of a fit from the minimum.

    This is so if, according to the derivatives, the sum of squares can decrease by no more than it
    changes within one standard error. Such a fit may not converge because the simulations are
    noisy.
    """
    jacobian, at = fit.solution.jacobian, fit.solution.at
    if fit.success:
        return True
    if jacobian is None or at is None or len(at.residuals) != len(jacobian):
        return False
    residuals, degrees = at.residuals, len(jacobian) - jacobian.shape[1]
    step = np.linalg.lstsq(jacobian, -residuals, rcond=1e-12)[0]
    fall = residuals @ residuals - np.sum((residuals + jacobian @ step) ** 2)
    return bool(degrees > 0 and fall <= residuals @ residuals / degrees)


def _held(each: Estimate, named: str) -> str:
    number = plain_number(each.value)
    return f"{named} at its {each.at_bound} bound, {number} {each.unit}".rstrip()


def _not_converged(model: str, fit: Result) -> str:
    """Say that a fit did not converge, so that its values are not the best ones."""
    why = str(fit.solution.ending).partition(";")[0]
    block = "" if model == DECLARED else ", with the [[effects]] block in the config"
    return (
        f"the last fit of {model} did not converge ({why}): its values, intervals and errors are "
        "those of the last point that the fit reached, so they are approximate; "
        f"to fit it again, run cluster-est fit{block}"
    )
