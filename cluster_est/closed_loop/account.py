"""The account of a closed loop: the last fits, the held-out data's veto, and all in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.findings.competing_models import (
    CompetingModel,
    competing_models,
    resampled_choices,
    with_choices,
    with_probabilities,
)
from cluster_est.closed_loop.findings.description import (
    describe_effects,
    error_changes,
    shared_arguments,
    where_left,
)
from cluster_est.closed_loop.findings.effect_curves import effect_curves
from cluster_est.closed_loop.findings.effects import ErrorChange, NoiseChange, Verdict
from cluster_est.closed_loop.findings.residual_noise import (
    believed_noise,
    residual_noise,
)
from cluster_est.closed_loop.findings.result import ErrorScale, LoopResult
from cluster_est.closed_loop.findings.unexplained import (
    UnexplainedResidual,
    unexplained_residuals,
    varying_columns,
)
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict, confirmed
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.selection.gates import SELECTION
from cluster_est.closed_loop.selection.rounds import ComparedStructure, SelectionResult
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.methods.least_squares.iteration import NOTICEABLE
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.facts import fitted_to_held_out
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.initial_errors import InitialError, initial_errors, initial_notes
from cluster_est.results.result import Result
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import examine

FINAL = LeastSquares(trials=2, max_iterations=50, differences="central")

STRAIGHT_STEPS = 3
"""Iterations of a fit to all rows in the values of the parameters, before the one that counts."""

NOT_ALLOWED_FOR = (
    "the intervals allow for noise alone, and not for what is left beyond it: they are too narrow "
    "by as much as that moves the estimates"
)


@dataclass(frozen=True)
class LastFits:
    """The last fits of the declared model and of the one with the effects.

    Attributes
    ----------
    before, after
        The same where nothing was added.
    errors, unchanged
        Of both side by side, and of the first beside itself.
    noise
        What the effects make of process noise, where there is some.
    """

    before: Result = field(repr=False)
    after: Result = field(repr=False)
    errors: tuple[ErrorChange, ...]
    unchanged: tuple[ErrorChange, ...]
    noise: tuple[NoiseChange, ...] = ()


def last_fits(workbench: LoopWorkbench, found: SelectionResult, begin: float) -> LastFits:
    """Fit both models to convergence from where the search ended."""
    starts = [model.start for model in last_models(found)]
    return _fitted_from(workbench, found, starts, begin, FINAL)


def last_fits_to_all_rows(
    workbench: LoopWorkbench,
    found: SelectionResult,
    starts: Sequence[FitStart],
    begin: float,
) -> LastFits:
    """Do so on a workbench with all rows, from what is best on fewer; see `best_on_few_rows`.

    The first steps are straight, too: along a valley the best of all rows may be some standard
    errors away.
    """
    experiments = workbench.problem.experiments
    moved = [
        replace(start, problem=replace(start.problem, experiments=experiments)) for start in starts
    ]
    method = replace(_of_many_rows(workbench.size), trials=1)
    first_steps = replace(method, max_iterations=STRAIGHT_STEPS)
    near = [start for start, _ in _straight_fits(workbench, moved, first_steps)]
    return _fitted_from(workbench, found, near, begin, method)


def best_on_few_rows(
    workbench: LoopWorkbench, starts: Sequence[FitStart]
) -> list[tuple[FitStart, FittedModel | None]]:
    """Fit both models to convergence on thinned records, for a fit to all rows to start from.

    A search does not fit to convergence, and what is left takes iterations each of which costs as
    much more as there are more rows. These fits are in the values of the parameters, no logarithms
    among them: two terms that the data hardly tell apart, such as two dampings, keep their sum
    along the valley between them, which is straight in their values and bent in their logarithms,
    so that many short steps would follow it.

    Returns
    -------
    list of (FitStart, FittedModel or None)
        Each model from where its fit has ended, and that fit; the start as it was, and None, where
        it cannot be simulated.
    """
    return _straight_fits(workbench, starts, _of_many_rows(workbench.size))


def _straight_fits(
    workbench: LoopWorkbench, starts: Sequence[FitStart], method: LeastSquares
) -> list[tuple[FitStart, FittedModel | None]]:
    """Fit in the values of the parameters, no logarithms among them."""
    found: list[tuple[FitStart, FittedModel | None]] = []
    for start in starts:
        linear = tuple(replace(p, scale="linear") for p in start.problem.parameters)
        straight = replace(start, problem=replace(start.problem, parameters=linear))
        (fit,) = workbench.fitter.fit(LoopStage.FINAL, [straight], method)
        found.append((start if fit is None else replace(start, values=fit.estimates), fit))
    return found


def last_models(found: SelectionResult) -> list[FittedModel]:
    """The declared model, and the one with effects where there are some."""
    return [found.base, found.current] if found.current.added else [found.base]


def _fitted_from(
    workbench: LoopWorkbench,
    found: SelectionResult,
    starts: Sequence[FitStart],
    begin: float,
    method: LeastSquares,
) -> LastFits:
    fits = [final_fit(workbench.fitter, start, begin, method) for start in starts]
    before, after = fits[0], fits[-1]
    changes = [error_changes(workbench, found, before, each) for each in (after, before)]
    return LastFits(before, after, changes[0], changes[1])


def account(
    workbench: LoopWorkbench, found: SelectionResult, judged: ReasonedVerdict, fits: LastFits
) -> LoopResult:
    """Let the held-out experiments veto what was found, and put it into words."""
    before, grown = fits.before, fits.after
    judgement = confirmed(judged, fits.errors, workbench.settings)
    keep = judgement.verdict in CLAIMS
    steps = GuardedSteps()
    curves: tuple[EffectCurve, ...] = ()
    if keep:
        curves = steps.do(
            "the shapes of the effects", lambda: effect_curves(workbench, found.current, grown), ()
        )
    named = describe_effects(workbench, found, grown, curves)
    after = grown if keep else before
    kept = found.current if keep else found.base
    unexplained = steps.do(
        "the description of what nothing explains",
        lambda: _unexplained(workbench, judgement.verdict, kept, found),
        (),
    )
    choices = None
    competing: tuple[CompetingModel, ...] = ()
    if keep:
        choices = steps.do(
            "how often the choice falls on these effects",
            lambda: resampled_choices(workbench, found),
            None,
        )
    if keep and not workbench.filtered:
        competing = steps.do(
            "the models that compete", lambda: competing_models(workbench, found), ()
        )
    begun = initial_errors(after.problem, after.simulations, fitted=True)
    compared = steps.do(
        "the probabilities of the structures",
        lambda: with_choices(_compared(judgement.verdict, found), choices),
        found.path,
    )
    notes = _notes(workbench, judgement.verdict, kept, before, after)
    failed = dict.fromkeys((*before.failed_steps, *after.failed_steps, *steps.failed))
    return LoopResult(
        verdict=judgement.verdict,
        summary="; ".join([judgement.reason, *_disturbance(judgement.verdict, unexplained, begun)]),
        effects=named if keep else (),
        before=before,
        after=after,
        errors=fits.errors if keep else fits.unchanged,
        findings=found.findings,
        rejected=() if keep else named,
        noise={} if workbench.filtered else workbench.noise_in_units(found.noise),
        sites=workbench.sites,
        notes=(*failed, *_nothing_tried(workbench, found), *notes),
        simulations=workbench.meter.full,
        simulated=workbench.runner.simulations,
        evaluations=workbench.runner.evaluations,
        failures=workbench.runner.failures,
        seconds=0.0,
        curves=curves,
        errors_over=_scale(workbench),
        structures=compared,
        resampled="" if choices is None else choices.sentence,
        unexplained=unexplained,
        competing=competing,
        process_noise=fits.noise if keep else (),
    )


def _scale(workbench: LoopWorkbench) -> ErrorScale:
    """What errors are divided by."""
    if workbench.filtered:
        return ErrorScale.PREDICTED
    return ErrorScale.SIGMA if workbench.sigma_declared else ErrorScale.ESTIMATED_NOISE


def _compared(verdict: Verdict, found: SelectionResult) -> tuple[ComparedStructure, ...]:
    """The structures that were compared; with probabilities, where noise is all that is left."""
    if verdict is not Verdict.FOUND:
        return found.path
    price = SELECTION.choice_price
    return with_probabilities(found.path, price * np.log(found.steps[0].screening.count))


def _unexplained(
    workbench: LoopWorkbench, verdict: Verdict, fitted: FittedModel, found: SelectionResult
) -> tuple[UnexplainedResidual, ...]:
    """What nothing explains, where something was looked for and the verdict says that it is."""
    if verdict not in (Verdict.PARTIAL, Verdict.UNEXPLAINED) or not found.steps:
        return ()
    if workbench.filtered:  # innovations have no size of their own beyond what the noise explains
        return ()
    outputs = residual_noise(workbench, fitted, found.noise)
    noise = believed_noise(workbench, outputs, found.noise)
    return _with_columns(workbench, fitted, unexplained_residuals(workbench, fitted, noise))


def _with_columns(
    workbench: LoopWorkbench, fitted: FittedModel, found: tuple[UnexplainedResidual, ...]
) -> tuple[UnexplainedResidual, ...]:
    """What nothing explains, with the unused columns that vary with it."""
    period = found[0].period if found else np.nan
    columns = varying_columns(workbench, fitted.residuals, period) if found else ()
    return tuple(
        replace(
            each,
            columns=tuple(
                c.sentence
                for c in columns
                if c.output == each.output or (not c.output and each is found[0])
            ),
        )
        for each in found
    )


def _disturbance(
    verdict: Verdict,
    unexplained: Sequence[UnexplainedResidual],
    begun: Sequence[InitialError] = (),
) -> tuple[str, ...]:
    """Say how large what nothing explains is, and how fast, if the start is not what is wrong."""
    if verdict is not Verdict.UNEXPLAINED or not unexplained:
        return ()
    if begun:
        return (f"{begun[0].sentence}; see to that first",)
    said = f"if it is a disturbance that nobody measured, it makes {unexplained[0].sentence}"
    return (said, *dict.fromkeys(c for each in unexplained for c in each.columns))


def _nothing_tried(workbench: LoopWorkbench, found: SelectionResult) -> tuple[str, ...]:
    """Say that not one effect could be tried, where that is so."""
    if not found.steps or found.steps[0].screening.ranking.trials:
        return ()
    settings = workbench.settings
    forms = f"forms {', '.join(settings.forms)}" if settings.forms else "forms of the library"
    return (
        f"no effect was tried: none of the {forms} makes sense on these data at "
        f"{', '.join(settings.sites or workbench.sites)} (some act at an output only where an "
        "input acts on it at once); change closed_loop.effects or closed_loop.sites",
    )


def _notes(
    workbench: LoopWorkbench,
    verdict: Verdict,
    fitted: FittedModel,
    before: Result,
    after: Result,
) -> tuple[str, ...]:
    """Sentences for the reader."""
    notes = (*workbench.notes, *_not_converged(before, after), *shared_arguments(fitted.added))
    if verdict in (Verdict.PARTIAL, Verdict.UNEXPLAINED):
        begun = initial_notes(after.problem, after.simulations)
        notes = (*notes, *begun, where_left(workbench, fitted), NOT_ALLOWED_FOR)
    if after.uncertainty is not None:
        notes = (*notes, *after.uncertainty.sentences)
    return (*notes, *fitted_to_held_out(after.estimates))


def _not_converged(before: Result, after: Result) -> tuple[str, ...]:
    """Say which of the last fits reached no solution, so that their values are not the best."""
    fits = {"the declared model": before}
    if after is not before:
        fits["the model with the effects"] = after
    return tuple(
        f"the last fit of {model} did not converge ({str(fit.solution.ending).partition(';')[0]}): "
        "its values, intervals and errors are those of the point where it stood"
        for model, fit in fits.items()
        if not fit.success
    )


def _of_many_rows(count: int) -> LeastSquares:
    """Return the method of the last fits to so many residuals, each simulation of which takes long.

    It ends where steps are below a tenth of the standard errors, beside which the error of forward
    differences is nothing.
    """
    ftol = max(FINAL.ftol, 0.25 * NOTICEABLE / count)
    return replace(FINAL, ftol=ftol, differences="forward", secant_updates=5)


def final_fit(
    fitter: Fitter, start: FitStart, begin: float, method: LeastSquares = FINAL
) -> Result:
    """Fit to convergence, and simulate every experiment; `begin` as for `complete`."""
    space = fitter.space(start)
    (solution,) = fitter.runner.run([SearchRequest("final", method, space, fitter.seed)])
    units = {n: v.unit for n, v in fitter.description.variables.items()}
    before = simulate_all(fitter.runner, start.problem, {})
    steps = GuardedSteps()
    known = steps.assessed(space, solution, lambda: examine(fitter.runner, space, solution))
    found = complete(
        fitter.runner,
        space,
        solution,
        method,
        before,
        units=units,
        seed=fitter.seed,
        begin=begin,
        steps=steps,
        uncertainty=known,
    )
    return replace(found, failed_steps=tuple(steps.failed))
