"""The alternatives of an effect: other effects that the data do not exclude."""

from __future__ import annotations

import math

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.effects import AlternativeEffect
from cluster_est.closed_loop.findings.naming import Namer, variables_of_effect
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.refits import RefittedCandidate
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.problem.display import SAME_PREDICTION, in_a_row, in_unit
from cluster_est.results.result import Result
from workers.effects.laws import Law
from workers.messages import FloatArray

LARGEST_DIFFERENCE = 10.0
"""Largest difference between the predictions of an effect and of its alternative, at any sample,
divided by the noise. If it is larger, the data distinguish the two effects, whatever their
criteria."""


def alternatives_of(
    fitter: Fitter,
    found: SelectionResult,
    candidate: EffectCandidate,
    namer: Namer,
    result: Result,
) -> tuple[AlternativeEffect, ...]:
    """Return the rivals that the data do not exclude: their predictions are similar everywhere.

    Other effects of the same structure are not rivals.
    """
    won, rivals = found.rivals.get(candidate.effect.name, (None, []))
    if won is None:
        return ()
    others = {c.effect.name for c in found.current.added if c is not candidate}
    made = []
    for rival in rivals:
        other = rival.candidate
        where, when, output, size = _largest_difference(
            fitter, won.fitted, rival.fitted, found.noise
        )
        if other.effect.name in others or not size <= LARGEST_DIFFERENCE:
            continue
        made.append(
            AlternativeEffect(
                site=str(other.site),
                form=other.form.name,
                family=other.form.family,
                variables=other.effect.variables,
                equation="" if other.form.law is Law.DELAYED else other.equation,
                criterion=float(rival.criterion - won.criterion),
                experiment=where,
                output=output,
                time=when,
                difference=size,
                words=namer.name(other, other.point(rival.fitted.coefficients(other)), None).words,
                parameters=_moved_parameters(result, rival),
                nested=size < SAME_PREDICTION and contains(other, candidate),
            )
        )
    return tuple(made)


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
