"""The facts of a fit for run.json."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cluster_est.problem.display import in_a_row
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import process_noise_notes, vanished_noise
from cluster_est.problem.variables import silent_notes
from cluster_est.results.after_jumps import after_jump_sentences
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.initial_errors import initial_notes
from cluster_est.results.interpolation import interpolation_facts
from cluster_est.results.observation import observation_notes
from cluster_est.results.output_errors import worse_than_constants
from cluster_est.results.record_faults.find import too_few_records
from cluster_est.results.solver_error.measure import solver_facts
from cluster_est.results.wrong_phase import wrong_phase_notes
from cluster_est.statistics.residual_findings import (
    OutputDiagnostics,
    ResidualDiagnostics,
    ResidualStructure,
    residual_sentences,
)

if TYPE_CHECKING:
    from cluster_est.results.result import Result


PRIOR_CONTRADICTION = 2.0
"""Distance from the centre of a prior, in standard deviations, above which an estimate contradicts
the prior. By chance, 1 of 20 estimates is that far away."""


def prior_sentences(problem: Problem, estimates: Sequence[Estimate]) -> tuple[str, ...]:
    """Return sentences on the contribution of priors to the cost, and on contradicted priors.

    Parameters
    ----------
    problem
        The fitted problem.
    estimates
        All estimates of a fit. Values that were estimated on held-out data do not add to the cost.
    """
    priors = {p.name: p.prior for p in problem.parameters if p.prior is not None}
    known = [(e, priors[e.parameter], e.estimated_on) for e in estimates if e.parameter in priors]
    if not known:
        return ()
    train = [prior.residual(each.value) for each, prior, on in known if on == "train"]
    added = sum(residual**2 for residual in train)
    said = []
    if train:
        one = len(train) == 1
        named = (
            "a prior, which counts like a measurement, adds"
            if one
            else (f"{len(train)} priors, which count like measurements, add")
        )
        said = [f"{named} {added:.3g} to the cost"]
    for each, prior, _ in known:
        residual = prior.residual(each.value)
        if abs(residual) > PRIOR_CONTRADICTION:
            where = "above" if residual > 0.0 else "below"
            said.append(
                f"{each.label} = {each.value:.4g} lies {abs(residual):.2g} standard deviations "
                f"{where} the centre of its prior ({prior.said()}): the measurements contradict "
                "the prior"
            )
    return tuple(said)


def residual_facts(diagnostics: ResidualDiagnostics) -> dict[str, Any]:
    """Return the entries of run.json on the residuals."""
    together = diagnostics.together
    return {
        "too_narrow": diagnostics.too_narrow,
        "outputs": [dataclasses.asdict(output) for output in diagnostics.outputs],
        "together": None if together is None else dataclasses.asdict(together),
        "sentences": list(residual_sentences(diagnostics)),
    }


HELD_OUT = 2.0
"""Ratio of the held-out error to the training error above which predictions are doubtful."""
MOST_NAMED_VALUES = 3
"""Largest number of values that a note names; further values are only counted."""


def fit_facts(result: Result) -> dict[str, Any]:
    """Return the entries of run.json on a fit, except those that the run's folder adds."""
    diagnostics = result.diagnostics
    return {
        "ending": result.solution.ending.name.lower(),
        "message": result.message,
        "cost_before": result.cost_before,
        "cost": result.cost,
        "rmse_over_sigma": {"train": result.rmse("train"), "test": result.rmse("test")},
        "residuals": None if diagnostics is None else residual_facts(diagnostics),
        "solver_error": solver_facts(result.solver_error),
        "interpolation": interpolation_facts(result.interpolation),
        "record_faults": [dataclasses.asdict(each) for each in result.record_faults],
        "criteria": dataclasses.asdict(result.criteria),
        "doubts": list(fit_doubts(result)),
        "notes": list(result.notes),
        "iterations": result.solution.iterations,
        "evaluations": result.evaluations,
        "simulations": result.simulated,
        "failures": result.failures,
        "seconds": result.seconds,
    }


def fit_notes(result: Result) -> tuple[str, ...]:
    """Return notes on the data, the simulations, the residuals and the uncertainty."""
    problem = result.problem
    notes = [*(each.sentence for each in result.record_faults)]
    notes += [*result.failed_steps, *problem.notes(result.linear_inputs)]
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
        other = result.interpolation
        blamed = "" if other is None else f"input {other.variable} has the wrong interpolation, or "
        notes += interpolation_sentences(result)
        notes += residual_sentences(result.diagnostics, blamed)
        missing = ResidualStructure.MISSING
        if any(o.structure is missing for o in result.diagnostics.findings):
            notes += () if result.record_faults else too_few_records(problem)
    notes += observation_notes(problem, result.simulations)
    notes += prior_sentences(problem, result.estimates)
    if result.solver_error is not None:
        notes += result.solver_error.sentences
    if result.uncertainty is not None:
        narrow = result.diagnostics is not None and result.diagnostics.too_narrow
        notes += result.uncertainty.sentences_of(systematic=narrow)
    for profile in result.profiles:
        notes += profile.sentences
    if result.bootstrap is not None:
        notes += result.bootstrap.sentences
    if result.posterior is not None:
        notes += result.posterior.sentences
    notes += fitted_to_held_out(result.estimates)
    return (*notes, *(_wrong_phase(result) or worse_than_constants(result.errors)))


def _wrong_phase(result: Result) -> tuple[str, ...]:
    """Return a note if other start values may lead to another minimum.

    This does not apply to fits with segments (multiple shooting), which keep the phase.
    """
    if result.shooting is not None:
        return ()
    return wrong_phase_notes(result.problem, result.simulations, max(len(result.starts), 1))


def interpolation_sentences(result: Result) -> tuple[str, ...]:
    """Return sentences on inputs that may need another interpolation, with the evidence."""
    other = result.interpolation
    told = "" if other is None else other.variable
    said = () if other is None else (other.sentence,)
    if result.diagnostics is None:
        return said
    return (
        *said,
        *after_jump_sentences(
            result.problem, result.simulations, result.diagnostics, told, result.linear_inputs
        ),
    )


def fit_doubts(result: Result) -> tuple[str, ...]:
    """Return short doubts about the solution of a fit; the notes give details."""
    doubts = []
    found = () if result.diagnostics is None else result.diagnostics.findings
    narrow = [each for each in found if each.too_narrow]
    if narrow:
        worst = max(narrow, key=_over_noise)
        of = "sigma" if worst.declared else "its noise"
        doubts.append(
            f"its intervals are too narrow, because the error of {worst.output} is "
            f"{_over_noise(worst):.2g} times {of}"
        )
    held_out, training = result.rmse("test"), result.rmse("train")
    if held_out > HELD_OUT * training > 0.0:
        doubts.append(f"its held-out error is {held_out / training:.2g} times the training error")
    if worse_than_constants(result.errors):
        doubts.append("a constant would fit an output better")
    if result.record_faults:
        doubts.append("a record looks wrong")
    if result.problem.data_findings:
        doubts.append("its data contain numbers that are probably not measurements")
    return tuple(doubts)


def _over_noise(output: OutputDiagnostics) -> float:
    return output.rms_over_sigma if output.declared else output.rms_over_noise


def fitted_to_held_out(estimates: Sequence[Estimate]) -> tuple[str, ...]:
    """Return a note on values fitted to held-out data, whose errors are not pure predictions."""
    fitted = [each for each in estimates if each.estimated_on == "test"]
    if not fitted:
        return ()
    names = list(dict.fromkeys(each.parameter for each in fitted))
    scopes = list(dict.fromkeys(repr(e.scope) for e in fitted if e.label != e.parameter))
    one = len(fitted) == 1
    of = f" (value{'' if one else 's'} for {_first(scopes)})" if scopes else ""
    were, they = ("was", "it") if one else ("were", "them")
    return (
        f"{_first(names)}{of} {were} fitted to the held-out data, because no training experiment "
        f"uses {they}; the held-out errors are therefore not pure predictions",
    )


def _first(names: Sequence[str]) -> str:
    """Return the first names of a list and the number of the others."""
    more = len(names) - MOST_NAMED_VALUES
    return in_a_row(list(names) if more <= 0 else [*names[:MOST_NAMED_VALUES], f"{more} more"])
