"""The facts of a fit for run.json."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cluster_est.problem.effects.process_noise import process_noise_notes, vanished_noise
from cluster_est.problem.idle_inputs import silent_notes
from cluster_est.results.initial_errors import initial_notes
from cluster_est.results.observation import observation_notes
from cluster_est.results.output_errors import worse_than_constants
from cluster_est.results.prior_sentences import prior_sentences
from cluster_est.results.residual_sentences import residual_facts, residual_sentences
from cluster_est.results.solver_error.measure import solver_facts

if TYPE_CHECKING:  # a result offers its facts, so it knows this file
    from cluster_est.results.result import Result
    from cluster_est.results.tables.row_types import Estimate

MOST_NAMED = 3
"""Values that a note names; it counts the others."""


def fit_facts(result: Result) -> dict[str, Any]:
    """Return what run.json says of a fit, besides what the run's folder knows itself."""
    diagnostics = result.diagnostics
    return {
        "ending": result.solution.ending.name.lower(),
        "message": result.message,
        "cost_before": result.cost_before,
        "cost": result.cost,
        "rmse_over_sigma": {"train": result.rmse("train"), "test": result.rmse("test")},
        "residuals": None if diagnostics is None else residual_facts(diagnostics),
        "solver_error": solver_facts(result.solver_error),
        "notes": list(result.notes),
        "iterations": result.solution.iterations,
        "evaluations": result.evaluations,
        "simulations": result.simulated,
        "failures": result.failures,
        "seconds": result.seconds,
    }


def fit_notes(result: Result) -> tuple[str, ...]:
    """Sentences about the simulations, the residuals and the uncertainty."""
    problem = result.problem
    notes = [*result.failed_steps, *problem.notes()]
    notes += silent_notes(problem, problem.describe())
    notes += process_noise_notes(problem)
    values = {each.label: each.value for each in result.estimates}
    notes += vanished_noise(
        problem, values, {e.label: (e.lower, e.upper) for e in result.estimates}
    )
    if result.shooting is not None:
        notes += result.shooting.sentences
    notes += initial_notes(problem, result.simulations)
    if result.diagnostics is not None:
        notes += residual_sentences(result.diagnostics)
    notes += observation_notes(problem, result.simulations)
    notes += prior_sentences(problem, result.estimates)
    if result.solver_error is not None:
        notes += result.solver_error.sentences
    if result.uncertainty is not None:
        notes += result.uncertainty.sentences
    for profile in result.profiles:
        notes += profile.sentences
    if result.bootstrap is not None:
        notes += result.bootstrap.sentences
    if result.posterior is not None:
        notes += result.posterior.sentences
    return (*notes, *fitted_to_held_out(result.estimates), *worse_than_constants(result.errors))


def fitted_to_held_out(estimates: Sequence[Estimate]) -> tuple[str, ...]:
    """Say which values were fitted to held-out data, whose errors are then no pure predictions."""
    labels = [each.label for each in estimates if each.estimated_on == "test"]
    if not labels:
        return ()
    named = ", ".join(labels[:MOST_NAMED])
    if len(labels) > MOST_NAMED:
        named += f" and {len(labels) - MOST_NAMED} more"
    which = "this value" if len(labels) == 1 else "these values"
    return (
        f"{named}: fitted to the held-out data, because no training experiment has {which}; errors "
        "there are those of a prediction from the right start",
    )
