"""The search of a closed loop at one workbench: fit, measure the solver's error, grow, judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict, judge
from cluster_est.closed_loop.numerical_error import (
    NumericalError,
    error_with_effects,
    measure_numerical_error,
)
from cluster_est.closed_loop.output_noise import expected_noise
from cluster_est.closed_loop.selection.beam_search import beam_search
from cluster_est.closed_loop.selection.moves import (
    functions_of_time,
    without_functions_of_time,
)
from cluster_est.closed_loop.selection.rounds import SelectionResult, without_search
from cluster_est.closed_loop.selection.starts import fit_declared
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.running.resources import Resources


@dataclass(frozen=True)
class SearchedModel:
    """What a search has found, and how exact its simulations are.

    Attributes
    ----------
    found, judged
        The models, and what the training experiments say of them.
    error
        Of the solver, at the declared model.
    error_at
        The same at a model with effects, where that is another.
    failures
        Simulations that failed while effects were tried.
    """

    found: SelectionResult = field(repr=False)
    judged: ReasonedVerdict
    error: NumericalError = field(repr=False)
    error_at: Callable[[FittedModel], NumericalError] = field(repr=False)
    failures: int = 0


def search_for_effects(
    workbench: LoopWorkbench,
    start: FitStart,
    resources: Resources,
    reached: Callable[[SelectionResult], None] = lambda _: None,
) -> SearchedModel:
    """Fit the declared model, and look for effects that it lacks.

    Parameters
    ----------
    start
        Of the declared model.
    resources
        For the simulations with a finer solver.
    reached
        Called after each round in which something was added, with all that was found so far.

    Raises
    ------
    ProblemError
        If the model cannot be simulated at its start.
    """
    workbench.enter("the declared model")
    base = fit_declared(workbench, start)
    noise = expected_noise(workbench, base.residuals)
    workbench.enter("the error of the solver")
    error = measure_numerical_error(workbench, base, noise, resources)
    with_effects = partial(
        error_with_effects, workbench, declared=error, noise=noise, resources=resources
    )
    before = workbench.runner.failures
    if error.hides_effects:
        found = without_search(workbench, base)
        judged = ReasonedVerdict(Verdict.UNEXPLAINED, error.refusal)
    else:
        found, judged = _searched(
            workbench, base, lambda fit: with_effects(fit).explainable, reached
        )
    failed = workbench.runner.failures - before
    return SearchedModel(found, judged, error, with_effects, failed)


def _searched(
    workbench: LoopWorkbench,
    base: FittedModel,
    numerical: Callable[[FittedModel], float],
    reached: Callable[[SelectionResult], None],
) -> tuple[SelectionResult, ReasonedVerdict]:
    """Look for effects; a function of time is one only where it leaves noise."""
    found = beam_search(workbench, base, numerical, reached=reached)
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
