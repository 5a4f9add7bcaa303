"""The recipe of the closed loop: fit, screen, refine, add, refit, report before and after.

Before the first effect is looked for, the error of the solver is measured beside the noise.

References: score tests with the declared parameters projected out follow C. R. Rao, Proc. Cambridge
Philos. Soc. 44 (1948) 50-57, doi:10.1017/S0305004100023987; growing a model where its residual
points follows N. R. Kristensen, H. Madsen, S. B. Jorgensen, Comput. Chem. Eng. 28 (2004) 1431-1449.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from cluster_est.closed_loop.findings.competing_models import competing_models
from cluster_est.closed_loop.findings.confirmation import confirmed
from cluster_est.closed_loop.findings.effect_curves import effect_curves
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.resampled_choice import resampled_choices, with_choices
from cluster_est.closed_loop.findings.residual.disturbance import (
    UnexplainedResidual,
    unexplained_residuals,
)
from cluster_est.closed_loop.findings.residual.noise_of_sensors import (
    believed_noise,
    residual_noise,
)
from cluster_est.closed_loop.findings.residual.unused_columns import varying_columns
from cluster_est.closed_loop.findings.result import ErrorScale, LoopResult
from cluster_est.closed_loop.findings.simulation_cost import dear_structures
from cluster_est.closed_loop.findings.structure_probabilities import with_probabilities
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict, judge
from cluster_est.closed_loop.findings.wording import (
    describe_effects,
    error_changes,
    shared_arguments,
    where_left,
)
from cluster_est.closed_loop.first_pass import open_checked_workbench
from cluster_est.closed_loop.measured_noise import expected_noise
from cluster_est.closed_loop.numerical_error.measure import (
    error_with_effects,
    measure_numerical_error,
)
from cluster_est.closed_loop.prepare import LoopRequest, checked_request
from cluster_est.closed_loop.selection.beam_search import beam_search
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.selection.functions_of_time import (
    functions_of_time,
    without_functions_of_time,
)
from cluster_est.closed_loop.selection.rounds import (
    ComparedStructure,
    SelectionResult,
    without_search,
)
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.problem import Problem
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.facts import fitted_to_held_out
from cluster_est.results.initial_errors import InitialError, initial_errors, initial_notes
from cluster_est.results.result import Result
from cluster_est.running.environment import Monitor
from cluster_est.running.records import Note, Record, Show
from cluster_est.running.resources import Resources
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import examine

FINAL = LeastSquares(trials=2, max_iterations=50, differences="central")


NOT_ALLOWED_FOR = (
    "the intervals allow for noise alone, and not for what is left beyond it: they are too narrow "
    "by as much as that moves the estimates"
)


def close_loop(
    problem: Problem,
    resources: Resources | None = None,
    settings: LoopSettings | None = None,
    seed: int = 0,
    *,
    record: Record | None = None,
    show: Show | None = None,
    note: Note | None = None,
) -> LoopResult:
    """Find what a model lacks, add it, and report the error before and after.

    Parameters
    ----------
    problem
        The declared model with its parameters and experiments. Experiments with role "test" choose
        nothing; they can only take a verdict away.
    resources
        Executor of the simulations, and the budget.
    settings
        Thresholds and sizes.
    seed
        Starts every random generator; the result is the same for any number of workers.
    record, show, note
        Called for each simulation, whenever something came back, and for each iteration; see
        `Runner`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    monitor = Monitor(record, show, note)
    return run_loop(checked_request(problem, resources, settings, seed, monitor))


def run_loop(request: LoopRequest) -> LoopResult:
    """Close the loop with workers, listeners and a budget that somebody else has chosen.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    begin = time.monotonic()
    with open_checked_workbench(request) as workbench:
        workbench.enter("the declared model")
        base = fit_declared(workbench, FitStart(workbench.problem, {}))
        noise = expected_noise(workbench, base.residuals)
        workbench.enter("the error of the solver")
        resources = request.environment.resources
        error = measure_numerical_error(workbench, base, noise, resources)
        with_effects = partial(
            error_with_effects, workbench, declared=error, noise=noise, resources=resources
        )
        before = workbench.runner.failures
        if error.hides_effects:
            found = without_search(workbench, base)
            judged = ReasonedVerdict(Verdict.UNEXPLAINED, error.refusal)
        else:
            found, judged = _searched(workbench, base, lambda fit: with_effects(fit).explainable)
        failed = workbench.runner.failures - before
        report = _report(workbench, found, judged, begin)
        last = with_effects(found.current) if report.effects else error
    seconds = time.monotonic() - begin
    said = (*error.notes, *(last.notes_with_effects if last is not error else ()))
    notes = (*said, *report.notes, *dear_structures(found.path))
    return replace(report, notes=notes, seconds=seconds, failures_in_search=failed)


def _searched(
    workbench: LoopWorkbench, base: FittedModel, numerical: Callable[[FittedModel], float]
) -> tuple[SelectionResult, ReasonedVerdict]:
    """Look for effects; a function of time is one only where it leaves noise."""
    found = beam_search(workbench, base, numerical)
    judged = judge(workbench, found)
    gone = functions_of_time(found)
    if judged.verdict is not Verdict.PARTIAL or not gone:
        return found, judged
    found = without_functions_of_time(workbench, found)
    judged = judge(workbench, found)
    if not found.current.added:
        return found, judged
    said = f"{' and '.join(c.label for c in gone)} would leave more than noise and was not added"
    return found, replace(judged, reason=f"{judged.reason}; {said}")


def _report(
    workbench: LoopWorkbench,
    found: SelectionResult,
    judged: ReasonedVerdict,
    begin: float,
) -> LoopResult:
    """Fit to convergence, let the held-out experiments veto, and put it into words."""
    workbench.enter("before and after")
    before = _final(workbench, found.base, begin)
    grown = _final(workbench, found.current, begin) if found.current.added else before
    changes = error_changes(workbench, found, before, grown)
    judgement = confirmed(judged, changes, workbench.settings)
    keep = judgement.verdict in CLAIMS
    curves = effect_curves(workbench, found.current, grown) if keep else ()
    named = describe_effects(workbench, found, grown, curves)
    after = grown if keep else before
    kept = found.current if keep else found.base
    over = ErrorScale.SIGMA if workbench.sigma_declared else ErrorScale.ESTIMATED_NOISE
    unexplained = _unexplained(workbench, judgement.verdict, kept, found)
    choices = resampled_choices(workbench, found) if keep else None
    begun = initial_errors(after.problem, after.simulations, fitted=True)
    return LoopResult(
        verdict=judgement.verdict,
        summary="; ".join([judgement.reason, *_disturbance(judgement.verdict, unexplained, begun)]),
        effects=named if keep else (),
        before=before,
        after=after,
        errors=changes if keep else error_changes(workbench, found, before, before),
        findings=found.findings,
        rejected=() if keep else named,
        noise=workbench.noise_in_units(found.noise),
        sites=workbench.sites,
        notes=(
            *_nothing_tried(workbench, found),
            *_notes(workbench, judgement.verdict, kept, before, after),
        ),
        simulations=workbench.meter.full,
        simulated=workbench.runner.simulations,
        evaluations=workbench.runner.evaluations,
        failures=workbench.runner.failures,
        seconds=0.0,
        curves=curves,
        errors_over=over,
        structures=with_choices(_compared(workbench, judgement.verdict, found), choices),
        resampled="" if choices is None else choices.sentence,
        unexplained=unexplained,
        competing=competing_models(workbench, found) if keep else (),
    )


def _compared(
    workbench: LoopWorkbench, verdict: Verdict, found: SelectionResult
) -> tuple[ComparedStructure, ...]:
    """The structures that were compared; with probabilities, where noise is all that is left."""
    if verdict is not Verdict.FOUND:
        return found.path
    price = workbench.thresholds.selection.choice_price
    return with_probabilities(found.path, price * np.log(found.steps[0].screening.count))


def _unexplained(
    workbench: LoopWorkbench, verdict: Verdict, fitted: FittedModel, found: SelectionResult
) -> tuple[UnexplainedResidual, ...]:
    """What nothing explains, where something was looked for and the verdict says that it is."""
    if verdict not in (Verdict.PARTIAL, Verdict.UNEXPLAINED) or not found.steps:
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


def _final(workbench: LoopWorkbench, fitted: FittedModel, begin: float) -> Result:
    """Fit to convergence from where the search ended, and simulate every experiment."""
    space = workbench.space(fitted.start)
    (solution,) = workbench.runner.run([SearchRequest("final", FINAL, space, workbench.seed)])
    units = {n: v.unit for n, v in workbench.description.variables.items()}
    start = simulate_all(workbench.runner, fitted.problem, {})
    known = examine(workbench.runner, space, solution)
    return complete(
        workbench.runner,
        space,
        solution,
        FINAL,
        start,
        units=units,
        seed=workbench.seed,
        begin=begin,
        uncertainty=known,
    )
