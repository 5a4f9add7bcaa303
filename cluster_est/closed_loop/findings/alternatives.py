"""The alternatives of an effect: other effects that the data do not exclude.

A search compares an effect with its rivals in the model that introduced the effect. Effects that
are added or dropped later, and widths that are estimated later, change all criteria, predictions
and parameters. So the rivals are fitted again in the final model before anything is said of them.

If two effects are functions of the same arguments and their predictions are equal, they are one law
that is written in two ways: with the balance A der(q) = p - R q, a resistance R that is linear in q
is a term that is quadratic in q.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.effects import AlternativeEffect
from cluster_est.closed_loop.findings.naming import Namer, variables_of_effect
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    PruningBound,
    can_reach,
    predicted_criterion,
)
from cluster_est.closed_loop.selection.refits import (
    SHORT,
    RefittedCandidate,
    best_first,
    ending_with,
    full_refit,
)
from cluster_est.closed_loop.selection.rounds import SelectionResult, compared_structure
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.problem.display import SAME_PREDICTION, in_a_row, in_unit
from cluster_est.results.result import Result
from workers.effects.laws import Law
from workers.effects.site import parse_site
from workers.messages import FloatArray

LARGEST_DIFFERENCE = 10.0
"""Largest difference between the predictions of an effect and of its alternative, at any sample,
divided by the noise. If it is larger, the data distinguish the two effects, whatever their
criteria."""


def refit_rivals(fitter: Fitter, found: SelectionResult) -> SelectionResult:
    """Return the result of a search with the rivals of its effects fitted in the final model.

    Rivals that were compared in this model are kept as they are. A rival is dropped if it cannot be
    simulated in this model, or if the data exclude it there. The search stops many refits early. If
    the linear model predicts that such a refit would have become a rival, it is continued here.
    """
    model, records = found.current, fitter.records
    own = best_first(records, [model])[0]
    rivals, asked = {**found.rivals}, list[tuple[str, FitStart]]()
    for position, candidate in enumerate(model.added):
        name = candidate.effect.name
        if name in rivals:
            won, known = rivals[name]
            rivals[name] = (won, [*known]) if is_same_model(won.fitted, model) else (own, [])
            asked += [(name, start) for start in _starts_of_rivals(fitter, found, position)]
    most = own.criterion + REFINEMENT.alternative
    fits = _refitted(fitter.limited_by(found.base), [start for _, start in asked], most)
    floor, rows = fitter.noise_floor(found.noise), []
    for (name, _), fit in zip(asked, fits, strict=True):
        if fit is not None:
            row = compared_structure(records, found.base, fit, floor, len(found.steps))
            rows.append(replace(row, accepted=False))
            if fit.criterion(records) <= most:
                rivals[name][1].append(*best_first(records, [fit]))
    return replace(found, rivals=rivals, path=(*found.path, *rows))


def _starts_of_rivals(fitter: Fitter, found: SelectionResult, position: int) -> list[FitStart]:
    """Return the starts of an effect's rivals that are not known in the final model."""
    model = found.current
    name = model.added[position].effect.name
    won, known = found.rivals[name]
    rivals = {each.candidate.effect.name: each for each in known}
    rivals = _stopped_early(fitter, found, won, name) | rivals
    if is_same_model(won.fitted, model):
        for each in known:
            del rivals[each.candidate.effect.name]
    return [
        _start_instead(model, position, won.fitted, rival)
        for other, rival in rivals.items()
        if other not in model.structure
    ]


def _stopped_early(
    fitter: Fitter, found: SelectionResult, won: RefittedCandidate, name: str
) -> dict[str, RefittedCandidate]:
    """Return the refits that stopped early and may become rivals of an effect, by their effect."""
    others = won.fitted.structure - {name}
    made: dict[str, RefittedCandidate] = {}
    for each in (contender for step in found.steps for contender in step.contenders):
        instead = sorted(each.fitted.structure - others)
        if (
            each.full
            or len(instead) != 1
            or instead[0] == name
            or not others < each.fitted.structure
        ):
            continue
        ahead = predicted_criterion(fitter.records, each.fitted)
        if ahead <= won.criterion + REFINEMENT.alternative:
            made.setdefault(instead[0], ending_with(each, instead[0]))
    return made


def is_same_model(one: FittedModel, other: FittedModel) -> bool:
    """Return whether two models have the same effects and the same unknowns."""
    own, others = ({unknown.label for unknown in fit.space.unknowns} for fit in (one, other))
    return one.structure == other.structure and own == others


def _start_instead(
    model: FittedModel, position: int, won: FittedModel, rival: RefittedCandidate
) -> FitStart:
    """Return the start of a model with a rival in the place of one of its effects.

    The declared parameters move as they moved from `won`, the model in which both were compared, to
    the model with the rival. The rival starts with the coefficients that it had there.
    """
    candidate = rival.candidate
    start = model.start.minus(position).plus(candidate, rival.fitted.coefficients(candidate))
    before, after = (
        dict(zip([u.label for u in fit.space.unknowns], fit.x.tolist(), strict=True))
        for fit in (won, rival.fitted)
    )
    effects, values = tuple(f"{c.effect.name}." for c in model.added), dict(start.values)
    ends = zip(model.space.lower.tolist(), model.space.upper.tolist(), strict=True)
    known = zip(model.space.unknowns, model.x.tolist(), ends, strict=True)
    for unknown, x, (low, high) in known:
        label = unknown.label
        if label in before and label in after and not label.startswith(effects):
            moved = x + after[label] - before[label]
            values[label] = unknown.to_physical(min(max(moved, low), high))
    return replace(start, values=values)


def _refitted(fitter: Fitter, starts: Sequence[FitStart], most: float) -> list[FittedModel | None]:
    """Fit models to convergence; None for one that fails or cannot reach a criterion of `most`."""
    fits = fitter.fit(LoopStage.REFITS, starts, SHORT) if starts else []
    bound = PruningBound(criterion=most)
    near = [
        i for i, fit in enumerate(fits)
        if fit is not None and can_reach(fitter.records, fit, bound)
    ]  # fmt: skip
    begun = [fit.start for i, fit in enumerate(fits) if i in near and fit is not None]
    full = fitter.fit(LoopStage.REFITS, begun, full_refit(fitter)) if begun else []
    done = dict(zip(near, full, strict=True))
    return [done.get(i) for i in range(len(starts))]


def alternatives_of(
    fitter: Fitter,
    found: SelectionResult,
    candidate: EffectCandidate,
    namer: Namer,
    result: Result,
) -> tuple[AlternativeEffect, ...]:
    """Return the rivals that the data do not exclude: their predictions are similar everywhere.

    Other effects of the same structure are not rivals. Rivals that were not compared in the final
    model have no numbers.
    """
    won, rivals = found.rivals.get(candidate.effect.name, (None, []))
    if won is None:
        return ()
    others = {c.effect.name for c in found.current.added if c is not candidate}
    final = is_same_model(won.fitted, found.current)
    made = []
    for rival in rivals:
        other = rival.candidate
        where, when, output, size = _largest_difference(
            fitter, won.fitted, rival.fitted, found.noise
        )
        if other.effect.name in others or not size <= LARGEST_DIFFERENCE:
            continue
        named = AlternativeEffect(
            site=str(other.site),
            form=other.form.name,
            family=other.form.family,
            variables=other.effect.variables,
            equation="" if other.form.law is Law.DELAYED else other.equation,
            criterion=math.nan,
            words=namer.name(other, other.point(rival.fitted.coefficients(other)), None).words,
        )
        if not final:
            made.append(named)
            continue
        criterion = float(rival.criterion - won.criterion)
        equal, more = size < SAME_PREDICTION, rival.fitted.space.size - won.fitted.space.size
        nested = equal and contains(other, candidate)
        same_law = equal and not nested and may_agree(other, candidate)
        if same_law and more > 0:
            continue  # the law itself, with a freedom that the data do not use
        made.append(
            replace(
                named,
                criterion=criterion,
                experiment=where,
                output=output,
                time=when,
                difference=size,
                parameters=_moved_parameters(result, rival),
                nested=nested,
                same_law=same_law,
                unknowns=more,
                better=bool(others) and criterion < -REFINEMENT.equal,
            )
        )
    return tuple(made)


def may_agree(one: EffectCandidate, other: EffectCandidate) -> bool:
    """Return whether two effects are functions of the same arguments, without internal states.

    If the predictions of two such effects are equal, they are one law. If the arguments differ,
    equal predictions only say that the arguments changed together in these data; and two filters
    may differ for faster signals.
    """
    static = all(not (each.form.states or each.form.memory) for each in (one, other))
    own, others = (variables_of_effect(each) or (each.site.target,) for each in (one, other))
    return static and set(own) == set(others)


def are_one_law(fitter: Fitter, found: SelectionResult, other: FittedModel) -> bool:
    """Return whether a model is the found one, with one of its effects written in another way."""
    one = found.current
    own = [c for c in one.added if c.effect.name not in other.structure]
    instead = [c for c in other.added if c.effect.name not in one.structure]
    if not len(own) == len(instead) == 1 or not may_agree(own[0], instead[0]):
        return False
    return _largest_difference(fitter, one, other, found.noise)[-1] < SAME_PREDICTION


MOST_WAYS = 3
"""Largest number of ways of writing a law that a sentence names."""


def same_law_sentence(alternatives: Sequence[AlternativeEffect]) -> str:
    """Say how else a law can be written, terms of a balance first; "" if no other way is known."""
    ways = [each for each in alternatives if each.same_law]
    if not ways:
        return ""
    ways.sort(key=lambda each: (not parse_site(each.site, each.form).at_rates, each.criterion))
    said = [_written(each) for each in ways[:MOST_WAYS]]
    more = len(ways) - len(said)
    said += [f"in {more} other way{'s' if more > 1 else ''}"] if more else []
    return f"On these data, the same law can also be written {' or '.join(said)}."


def _written(way: AlternativeEffect) -> str:
    fewer = f"{-way.unknowns} unknown{'s' if way.unknowns < -1 else ''} less"
    details = [
        way.equation,
        f"with {way.parameters}" if way.parameters else "",
        fewer if way.unknowns < 0 else "",
    ]
    inside = "; ".join(filter(None, details))
    return f"as {way.words} at {way.site}" + (f" ({inside})" if inside else "")


WITHOUT_ITS_TIME = {
    Law.LAGGED: Law.LINEAR,
    Law.DELAYED: Law.LINEAR,
    Law.LAGGED_SQUARE: Law.SQUARE,
    Law.TWO_LAGS: Law.LAGGED,
    Law.SECOND_ORDER_LAG: Law.FIRST_ORDER_LAG,
    Law.TWO_STORES: Law.STORE,
}
"""By law: the law to which it tends as its delay, or one of its time constants, tends to 0."""


def contains(rival: EffectCandidate, candidate: EffectCandidate) -> bool:
    """Return whether a rival is the law of an effect if one of the rival's times is 0."""
    place = rival.site == candidate.site and (
        variables_of_effect(rival) == variables_of_effect(candidate)
    )
    limit = WITHOUT_ITS_TIME.get(rival.form.law)
    return place and candidate.form.law in (limit, limit and WITHOUT_ITS_TIME.get(limit))


MOST_MOVED = 3
"""Largest number of parameters that are named because another effect gives them other values."""


def _moved_parameters(result: Result, rival: RefittedCandidate) -> str:
    """Name the declared parameters whose values with a rival are outside of their intervals."""
    if not (rival.full or rival.fitted.converged):
        return ""
    values, effects = rival.fitted.estimates, [f"{e.name}." for e in result.problem.effects]
    moved = []
    for each in result.estimates:
        half, value = 0.5 * (each.upper95 - each.lower95), values.get(each.label, math.nan)
        shared = each.label == each.parameter and not each.label.startswith(tuple(effects))
        if shared and half > 0.0 and abs(value - each.value) > half:
            said = f"{each.label} = {value:.4g} instead of {each.value:.4g}{in_unit(each.unit)}"
            moved.append((-abs(value - each.value) / half, said))
    return in_a_row([said for _, said in sorted(moved)[:MOST_MOVED]]) if moved else ""


def _largest_difference(
    fitter: Fitter, one: FittedModel, other: FittedModel, noise: FloatArray
) -> tuple[str, float, str, float]:
    """Experiment, time, output and size of the largest difference of two models' predictions.

    The size is divided by the noise of that output.
    """
    gap = np.abs(one.residuals - other.residuals)
    for record in fitter.records.items:
        gap[record.rows] /= max(float(noise[record.output]), 1e-300)
    row = int(np.argmax(gap))
    record = next(r for r in fitter.records.items if r.rows.start <= row < r.rows.stop)
    time = float(record.times[row - record.rows.start])
    output = fitter.records.outputs[record.output]
    return fitter.runs[record.experiment].id, time, output, float(gap[row])
