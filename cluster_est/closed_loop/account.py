"""The end of a search: the check on held-out data, and the result in words.

A preliminary result is also made after each round, in case the search is interrupted.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.alternatives import refit_rivals
from cluster_est.closed_loop.findings.claim_evidence import (
    doubted,
    how_sure,
    with_claims,
    without_claims,
)
from cluster_est.closed_loop.findings.competing_models import (
    CompetingModel,
    choice_price,
    competing_models,
    leading_models,
    resampled_choices,
    with_choices,
    with_probabilities,
    written_otherwise,
)
from cluster_est.closed_loop.findings.description import (
    describe_effects,
    describe_untested,
    error_changes,
    is_like_ramp,
    shared_arguments,
    taken_for_definitions,
    where_left,
)
from cluster_est.closed_loop.findings.effect_curves import effect_curves
from cluster_est.closed_loop.findings.effects import NamedEffect, Verdict, over_noise, pooled_error
from cluster_est.closed_loop.findings.result import ErrorScale, LoopResult
from cluster_est.closed_loop.findings.unexplained import (
    UnexplainedResidual,
    unexplained_residuals,
    varying_columns,
)
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict, judge
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.last_fits import LastAnswer, LastFits, as_it_is
from cluster_est.closed_loop.output_noise import (
    believed_noise,
    noise_of,
    residual_noise,
    rounding_notes,
)
from cluster_est.closed_loop.selection.rounds import (
    ComparedStructure,
    SelectionResult,
    leaves_more_than_noise,
)
from cluster_est.closed_loop.settings import CandidateStage
from cluster_est.closed_loop.workbench import LoopScope
from cluster_est.errors import ClusterEstError
from cluster_est.problem.display import in_sentences
from cluster_est.problem.tables.jumps import jumping_inputs
from cluster_est.results.facts import fitted_to_held_out
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.initial_errors import InitialError, initial_errors, initial_notes
from cluster_est.results.record_faults.find import too_few_records
from cluster_est.results.result import Result
from workers.messages import FloatArray

NOT_ALLOWED_FOR = (
    "the remaining error is larger than the noise, and the confidence intervals do not allow for "
    "errors of the model, so they are too narrow"
)


def account(
    fitter: Fitter,
    answer: LastAnswer,
    scope: LoopScope,
    linear: Collection[str] = (),
    *,
    preliminary: bool = False,
) -> LoopResult:
    """Check the answer on the held-out experiments, and return the result with its texts.

    `linear` are the inputs whose linear interpolation the measurements confirm. For a preliminary
    result, the rivals of the effects are not fitted again.
    """
    steps = GuardedSteps()
    if not preliminary:
        answer = _with_final_rivals(fitter, answer, steps)
    found, fits = answer.found, answer.fits
    before, grown = fits.before, fits.after
    judgement, keep = answer.confirmed, answer.keeps_effects
    after, kept = (grown, found.current) if keep else (before, found.base)
    curves: tuple[EffectCurve, ...] = ()
    competing: tuple[CompetingModel, ...] = ()
    choices = None
    labels = {c.effect.name: c.label for c in kept.added}
    judgement, doubts = doubted(judgement, labels, before, after)
    if keep:
        shapes = "the shapes of the effects"
        curves = steps.do(shapes, lambda: effect_curves(fitter, kept, grown), ())
        often = "how often these effects are chosen"
        choices = steps.do(often, lambda: resampled_choices(fitter, found), None)
    named = _named(fitter, answer, judgement, curves, with_choices(found.path, choices))
    named = named if keep else _strongest_first(found, named)
    judgement = without_claims(judgement, named) if keep else judgement
    if keep and not fitter.predicts:
        competing = steps.do("the models that compete", lambda: competing_models(fitter, found), ())
    unexplained = steps.do(
        "the description of the unexplained residual",
        lambda: _unexplained(fitter, judgement.verdict, kept, found),
        (),
    )
    begun = initial_errors(after.problem, after.simulations, fitted=True)
    compared = steps.do(
        "the probabilities of the structures",
        lambda: with_choices(_compared(fitter, judgement.verdict, found), choices),
        found.path,
    )
    compared = steps.do(
        "the errors of the structures that were accepted",
        lambda: _with_errors(fitter, found, compared, before),
        compared,
    )
    others, first = _disturbance(judgement.verdict, unexplained, begun)
    said = [judgement.reason, how_sure(named, claimed=keep), *others]
    noise = {} if fitter.predicts else fitter.noise_in_units(last_noise(fitter, found, keep=keep))
    scale = ErrorScale.SIGMA if fitter.sigma_declared else ErrorScale.ESTIMATED_NOISE
    failed = dict.fromkeys((*before.failed_steps, *after.failed_steps, *steps.failed))
    ramps = [effect for effect in kept.added if effect.site.target not in linear]
    notes = (
        *failed,
        *_nothing_tried(found, scope.sites),
        *taken_for_definitions(found.definitions),
        *doubts,
        *answer.against,
        *scope.notes,
        *_notes_on_inputs(fitter, judgement.verdict, kept, found.noise, scope, linear),
        *rounding_notes(fitter, noise),
        *shared_arguments(kept.added),
        *like_ramps(fitter, ramps),
        *_notes(fitter, judgement.verdict, kept, after, found.noise),
    )
    return LoopResult(
        verdict=judgement.verdict,
        message=in_sentences(said),
        effects=named if keep else (),
        before=before,
        after=after,
        errors=fits.errors if keep else tuple(each.unchanged for each in fits.errors),
        findings=found.findings,
        rejected=() if keep else named,
        noise=noise,
        sites=found.sites,
        notes=notes,
        simulations=fitter.meter.full,
        simulated=fitter.runner.simulations,
        evaluations=fitter.runner.evaluations,
        failures=fitter.runner.failures,
        seconds=0.0,
        curves=curves,
        errors_over=ErrorScale.PREDICTED if fitter.predicts else scale,
        structures=compared,
        resampled="" if choices is None else choices.sentence,
        unexplained=unexplained,
        competing=competing,
        process_noise=fits.noise if keep else (),
        first=judgement.first or first,
    )


def _with_final_rivals(fitter: Fitter, answer: LastAnswer, steps: GuardedSteps) -> LastAnswer:
    """Return an answer whose effects are compared with their rivals in the final model."""
    fitter.enter("the rivals of the effects")
    what = "the comparison of the effects with their rivals in the final model"
    found = steps.do(what, lambda: refit_rivals(fitter, answer.found), answer.found)
    return replace(answer, found=found)


def _named(
    fitter: Fitter,
    answer: LastAnswer,
    judgement: ReasonedVerdict,
    curves: Sequence[EffectCurve],
    compared: Sequence[ComparedStructure],
) -> tuple[NamedEffect, ...]:
    """Name the effects of an answer, or the best that were tried, and say how sure they are."""
    found, fits = answer.found, answer.fits
    named = describe_effects(fitter, found, fits.after, curves)
    if not named and judgement.verdict is Verdict.UNEXPLAINED:
        named = _best_tried(fitter, found)
    if fitter.predicts:  # the benchmark has hardly any claims with process noise
        return named
    errors = over_noise(fits.errors, judgement.noise)
    declared, claimed = fitter.sigma_declared, answer.keeps_effects
    return with_claims(named, errors, compared, declared=declared, claimed=claimed)


def last_noise(fitter: Fitter, found: SelectionResult, *, keep: bool) -> FloatArray:
    """Return the noise, (outputs,): with effects that are kept, from what they leave.

    The search and the errors use the noise in the residuals of the declared model.
    """
    return noise_of(fitter, found.current.residuals) if keep else found.noise


def _best_tried(fitter: Fitter, found: SelectionResult) -> tuple[NamedEffect, ...]:
    """Return the effects of the best set that was tried, if a search accepted none."""
    tried = (fit for fit in leading_models(fitter, found, 2) if fit.added)
    best = next(tried, None)
    return () if best is None else describe_untested(fitter, best)


def _compared(
    fitter: Fitter, verdict: Verdict, found: SelectionResult
) -> tuple[ComparedStructure, ...]:
    """Return the compared structures, with probabilities if the residual is only noise."""
    if verdict is not Verdict.FOUND:
        return found.path
    same = written_otherwise(fitter, found)
    return with_probabilities(found.path, choice_price(found), same)


def _strongest_first(
    found: SelectionResult, leads: tuple[NamedEffect, ...]
) -> tuple[NamedEffect, ...]:
    """Order leads by their step; of those of one step, the one that explains most comes first."""
    known = {
        (each.site, each.form, each.variables): (each.step, -each.explained)
        for each in found.findings
        if each.stage is CandidateStage.ACCEPTED
    }
    return tuple(sorted(leads, key=lambda e: known.get((e.site, e.form, e.variables), (0, 0.0))))


def _with_errors(
    fitter: Fitter,
    found: SelectionResult,
    compared: tuple[ComparedStructure, ...],
    before: Result,
) -> tuple[ComparedStructure, ...]:
    """Add errors to the accepted structures, only for the report."""
    errors = {}
    for each in found.accepted[1:]:
        held_out = np.nan
        if fitter.problem.indices("test") and not fitter.predicts:
            result = as_it_is(fitter, each.model, time.monotonic())
            changes = error_changes(fitter, found, before, result)
            held_out = pooled_error(changes, "test", after=True)
        left_out = float(np.sqrt(each.prediction.total / fitter.size))
        errors[tuple(c.label for c in each.model.added)] = left_out, held_out
    rows = []
    for row in reversed(compared):  # if a structure has several rows, the last one gets its errors
        left_out, held_out = errors.pop(row.effects, (np.nan, np.nan))
        rows.append(replace(row, left_out=left_out, held_out=held_out))
    return tuple(reversed(rows))


def _unexplained(
    fitter: Fitter, verdict: Verdict, fitted: FittedModel, found: SelectionResult
) -> tuple[UnexplainedResidual, ...]:
    """Describe the unexplained part of the residual, if the verdict says that there is one."""
    if verdict not in (Verdict.PARTIAL, Verdict.UNEXPLAINED) or not found.steps:
        return ()
    if fitter.predicts:  # in innovations, an unexplained part has no size apart from the noise
        return ()
    outputs = residual_noise(fitter, fitted, found.noise)
    noise = believed_noise(fitter, outputs, found.noise)
    left = unexplained_residuals(fitter, fitted, noise)
    if not left:
        return ()
    significance, period = found.settings.significance, left[0].period
    columns = varying_columns(fitter, fitted.residuals, significance, period)
    named = [(each.output,) if number else ("", each.output) for number, each in enumerate(left)]
    return tuple(
        replace(each, columns=tuple(c.sentence for c in columns if c.output in outputs))
        for each, outputs in zip(left, named, strict=True)
    )


def _disturbance(
    verdict: Verdict,
    unexplained: Sequence[UnexplainedResidual],
    begun: Sequence[InitialError],
) -> tuple[tuple[str, ...], str]:
    """Return sentences on the unexplained part's size and period, or on a wrong initial state.

    The second value says what to do before everything else; "" for nothing.
    """
    if verdict is not Verdict.UNEXPLAINED or not unexplained:
        return (), ""
    if begun:
        first = "leave out the start" if begun[0].settling else "correct the initial state"
        return (f"{begun[0].sentence}; {first} first",), first
    said = (
        "the cause may also be an unmeasured disturbance; it would have to change "
        f"{unexplained[0].sentence}"
    )
    return (said, *dict.fromkeys(c for each in unexplained for c in each.columns)), ""


def _nothing_tried(found: SelectionResult, sites: tuple[str, ...]) -> tuple[str, ...]:
    """Return a note if no effect could be tried."""
    if not found.steps or found.steps[0].screening.ranking.trials:
        return ()
    settings = found.settings
    forms = f"forms {', '.join(settings.forms)}" if settings.forms else "forms of the library"
    return (
        f"no effect was tried: with these data, none of the {forms} can be used at the sites "
        f"{', '.join(settings.sites or sites)} (some forms can be used at an output only if an "
        "input affects this output directly); change closed_loop.effects or closed_loop.sites",
    )


def _notes(
    fitter: Fitter,
    verdict: Verdict,
    fitted: FittedModel,
    after: Result,
    noise: FloatArray,
) -> tuple[str, ...]:
    """Return the notes on unexplained residuals and the estimates."""
    notes: tuple[str, ...] = ()
    missing = verdict in (Verdict.PARTIAL, Verdict.UNEXPLAINED)
    systematic = missing and leaves_more_than_noise(fitted, fitter.noise_floor(noise))
    if missing:
        begun = initial_notes(after.problem, after.simulations)
        notes = (*notes, *begun)
        if systematic:
            few = too_few_records(after.problem)
            notes = (*notes, *few, where_left(fitter, fitted), NOT_ALLOWED_FOR)
    if after.uncertainty is not None:
        notes = (*notes, *after.uncertainty.sentences_of(systematic=systematic))
    return (*notes, *fitted_to_held_out(after.estimates))


def _notes_on_inputs(
    fitter: Fitter,
    verdict: Verdict,
    fitted: FittedModel,
    noise: FloatArray,
    scope: LoopScope,
    linear: Collection[str],
) -> tuple[str, ...]:
    """Return the notes on inputs that may need a hold, if their interpolation may matter.

    A wrong interpolation looks like a delay or a lag. If only noise is left, and no effect
    remembers the past, it has left no trace in the answer.
    """
    explained = verdict in (Verdict.FOUND, Verdict.NONE)
    remembers = any(c.form.memory or c.form.states for c in fitted.added)
    left = leaves_more_than_noise(fitted, fitter.noise_floor(noise))
    return () if explained and not (remembers or left) else scope.notes_on_inputs(linear)


def like_ramps(fitter: Fitter, added: Sequence[EffectCandidate]) -> tuple[str, ...]:
    """Say which effects may come from the linear interpolation of an input that jumps."""
    found = [c for c in added if is_like_ramp(c)]
    jumping = jumping_inputs(fitter.runs, fitter.description.holds) if found else {}
    return tuple(
        f"{c.label} may come in part from the linear interpolation of input {c.site.target}, which "
        "turns jumps into ramps: if the real input keeps each value until the next sample, set "
        'interpolation = "hold" for this input and run again before you rely on this effect'
        for c in found
        if c.site.target in jumping
    )


NOT_THE_LAST = (
    "this result is preliminary: its values are those of the search, before the last fits, and "
    "there may be further effects; if the run has stopped, continue it with --resume"
)


def result_so_far(
    fitter: Fitter,
    found: SelectionResult,
    begin: float,
    scope: LoopScope,
    linear: Collection[str] = (),
    said: str = "",
) -> LoopResult | None:
    """Return a preliminary result with the best structure so far; None if this fails.

    Its simulations are neither counted nor logged, so that the rest of the run does not depend on
    them. For `linear` see `account`. `said` is a note on the records that the search uses; "" for
    none.
    """
    try:
        with fitter.runner.uncounted():
            judged = judge(fitter, found).so_far
            before, after = (as_it_is(fitter, fit, begin) for fit in (found.base, found.current))
            fits = LastFits(before, after, error_changes(fitter, found, before, after))
            answer = LastAnswer(found, judged, fits)
            result = account(fitter, answer, scope, linear, preliminary=True)
    except ClusterEstError:
        return None
    most = found.settings.max_effects
    rounds = f"the search stopped after round {len(found.steps)} of at most {most}"
    return replace(
        result,
        message=f"{rounds}: {result.message}",
        notes=(*filter(None, (NOT_THE_LAST, said)), *result.notes),
        seconds=after.seconds,
    )
