"""Diagnostics of a fitted model, and effects added to a problem by hand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cluster_est.closed_loop.candidates.scales import SignalScales
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.numerical_error import NumericalError, measure_numerical_error
from cluster_est.closed_loop.outliers import open_checked_workbench
from cluster_est.closed_loop.output_noise import expected_noise, noise_of
from cluster_est.closed_loop.screening.screen import CandidateEvidence, findings, screen
from cluster_est.closed_loop.selection.starts import fit_declared
from cluster_est.closed_loop.settings import CandidateStage, LoopSettings
from cluster_est.closed_loop.workbench import LoopRequest, check_arguments, open_workbench
from cluster_est.errors import EffectError, ProblemError
from cluster_est.problem.declared_effects import DeclaredCoefficient, DeclaredEffect, make_effect
from cluster_est.problem.free_curves import Monotone, checked_shape
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import refuse_process_noise
from cluster_est.running.arguments import check_problem, checked_resources, prepared
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import Resources
from cluster_est.statistics.residual_tests import FAMILY_WISE_LEVEL
from workers.effects.forms import EffectForm, FormCoefficient
from workers.effects.forms import form as find_form
from workers.effects.site import EffectSite, check_site, parse_site, unnamed_variables
from workers.messages.checks import as_tuple, check_kind, check_name, check_number, check_text


@dataclass(frozen=True)
class DetectionResult:
    """The evidence that a fitted model lacks something.

    Attributes
    ----------
    p
        Probability that, with noise alone, some candidate explains as much as the best one does.
    p_white
        The same probability after the residual and the candidates were whitened. It is not small if
        the residual is only autocorrelated noise.
    p_structure
        The same probability for any smooth structure of the residual, without candidates.
    candidates
        Number of compared candidates, without those that a parameter can imitate.
    noise, rms
        Estimated standard deviation of each output's noise, and root mean square of its residual,
        in the output's unit.
    significance
        Significance level with which the p-values are compared.
    numerical_error
        Why effects cannot be distinguished from the numerical error of the solver; empty if this
        error is small.
    notes
        Sentences on the numerical error, if it is not negligible or could not be measured.
    """

    p: float
    p_white: float
    p_structure: float
    candidates: int
    noise: Mapping[str, float]
    rms: Mapping[str, float]
    significance: float
    numerical_error: str = ""
    notes: tuple[str, ...] = ()

    @property
    def missing(self) -> bool:
        """Whether some candidate explains more than noise or the numerical error could."""
        return max(self.p, self.p_white) <= self.significance and not self.numerical_error

    @property
    def sentence(self) -> str:
        if self.numerical_error:
            return self.numerical_error
        if self.missing:
            count = f"{self.candidates} candidate{'' if self.candidates == 1 else 's'}"
            return f"the model lacks something ({_p(self.p)} among {count})"
        smooth = self.p_structure <= FAMILY_WISE_LEVEL
        if not self.candidates:
            found = "has smooth structure" if smooth else "looks like noise"
            return f"the residual {found} ({_p(self.p_structure)}), but no candidate was compared"
        if self.p <= self.significance:
            return (
                "the residual is autocorrelated, and no candidate explains it (p = "
                f"{self.p_white:.2g})"
            )
        if smooth:
            return (
                f"no candidate is significant (p = {self.p:.2g}), but the residual has smooth "
                f"structure ({_p(self.p_structure)})"
            )
        return f"no missing effect is visible in the data (p = {self.p:.2g})"


def detect(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    settings: LoopSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
) -> DetectionResult:
    """Fit a problem and test whether its residual is more than noise.

    Parameters
    ----------
    problem
        The declared model, including any effects that it already has.
    resources, settings, seed
        As for `close_loop`.

    Raises
    ------
    ClusterEstError
        As `close_loop`.
    """
    request = _checked_request(problem, resources, settings, seed)
    with _fitted(request) as (fitter, fitted, error):
        screening = screen(fitter, request.settings, fitted, 1)
        parts = fitter.records.by_output(fitted.residuals)
        rms = np.array([np.sqrt(np.mean(part**2)) if len(part) else np.nan for part in parts])
        return DetectionResult(
            p=screening.p,
            p_white=screening.p_white,
            p_structure=screening.structure.p,
            candidates=screening.count,
            noise=fitter.noise_in_units(noise_of(fitter, fitted.residuals)),
            rms=fitter.noise_in_units(rms),
            significance=request.settings.significance,
            numerical_error=error.refusal if error.hides_effects else "",
            notes=error.notes,
        )


def locate(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    settings: LoopSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
) -> tuple[CandidateEvidence, ...]:
    """Fit a problem and rank the candidates for a missing effect.

    The ranking uses the change of the outputs by a very small effect. A large effect may change the
    outputs differently, so the ranking is only a hint. `close_loop` simulates and refits the best
    candidates. Candidates that the declared parameters can imitate come last.

    Parameters
    ----------
    problem, resources, settings, seed
        As for `detect`.

    Raises
    ------
    ClusterEstError
        As `close_loop`, and if effects cannot be distinguished from the error of the solver.
    """
    request = _checked_request(problem, resources, settings, seed)
    with _fitted(request) as (fitter, fitted, error):
        if error.hides_effects:
            raise ProblemError(error.refusal)
        found = findings(screen(fitter, request.settings, fitted, 1).ranking, fitted, 1).values()
        return tuple(sorted(found, key=lambda f: (f.stage is CandidateStage.SET_ASIDE, f.log_p)))


def add_effect(
    problem: Problem,
    site: str,
    form: str = "",
    equation: str = "",
    variables: Sequence[str] = (),
    name: str = "",
    *,
    start: Mapping[str, float] | None = None,
    reaction: str = "",
    slope_change: float | None = None,
    monotone: Monotone = "",
    bounds: tuple[float, float] | None = None,
) -> Problem:
    """Add an effect to a problem, with its coefficients as parameters.

    Strengths start at the value at which the effect has no influence. Some coefficients have no
    such value, like a width, or are divisors, like the time constant of a lag. Their start values
    are derived from the size of the signals. For this, each training experiment is simulated at the
    problem's start values. Coefficients that a search does not estimate, like the width of a
    switch, are fixed.

    Parameters
    ----------
    problem
        The problem to which the effect is added; it is not changed.
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form, equation
        Either the name of a form in the library, or an equation with the FMU's names.
    variables
        Arguments of a form; default: the state of der(STATE).
    name
        Name of the effect; default: the name of the form.
    start
        Start values of coefficients, by name. Your own equation needs one for each coefficient.
    reaction
        For an equation at a pair: the term that is added to the derivative of the second state.
    slope_change, monotone, bounds
        For a free curve, such as the form "table". `slope_change` is a prior: the standard
        deviation of the change of slope over one unit of the argument. `monotone` is a constraint:
        "increasing" or "decreasing". `bounds` are the bounds of the values. See
        `cluster_est.problem.free_curves`.

    Raises
    ------
    ClusterEstError
        If the site is closed, the form or equation is wrong, or a coefficient has no start value.
    """
    check_problem(problem)
    check_name(site, "effect.site", EffectError)
    texts = {"form": form, "equation": equation, "name": name, "reaction": reaction}
    for key, text in texts.items():
        check_text(text, f"effect.{key}", EffectError)
    variables = as_tuple(variables, str, "effect.variables", EffectError)
    starts, shape = _starts(start), checked_shape(slope_change, monotone, bounds)
    held: tuple[str, ...] = ()
    if form and not equation:
        place, chosen = _form_at(problem, site, form, f"effect {name or form!r}")
        missing = [
            c
            for c in chosen.coefficients
            if (c.neutral is None or chosen.divides_by(c.name)) and c.name not in starts
        ]
        held = tuple(c.name for c in missing if c.held)
        if missing:
            about = variables or unnamed_variables(chosen, place)
            starts |= _sized(problem, place, about, missing)
    coefficients = {
        key: DeclaredCoefficient(start=value, fixed=key in held) for key, value in starts.items()
    }
    made = make_effect(
        DeclaredEffect(name, site, form, equation, variables, coefficients, reaction, shape)
    )
    grown = replace(
        problem,
        effects=(*problem.effects, made.effect),
        parameters=(*problem.parameters, *made.parameters),
        constraints=(*problem.constraints, *made.constraints),
    )
    grown.describe()
    return grown


def _checked_request(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None,
    settings: LoopSettings | Mapping[str, Any] | None,
    seed: int,
) -> LoopRequest:
    """Check a user's arguments like a config, and return them as a request."""
    problem, chosen = prepared(problem), LoopSettings.of(settings)
    check_arguments(problem, chosen, seed)
    return LoopRequest(problem, RunEnvironment(checked_resources(resources)), chosen, seed)


@contextmanager
def _fitted(request: LoopRequest) -> Iterator[tuple[Fitter, FittedModel, NumericalError]]:
    """Yield a fitter, the fitted declared model, and the numerical error of its simulations."""
    refuse_process_noise(request.problem, "detect and locate")
    with open_checked_workbench(request) as workbench:
        fitter, start = workbench.fitter, FitStart(workbench.fitter.problem, {})
        fitted = fit_declared(fitter, start, request.settings.starts, workbench.first_fit)
        noise = expected_noise(fitter, fitted.residuals)
        resources = request.environment.resources
        yield fitter, fitted, measure_numerical_error(fitter, fitted, noise, resources)


def _starts(given: Mapping[str, float] | None) -> dict[str, float]:
    """Return the start values of coefficients, after a check that each is a number."""
    advice = "; write {coefficient: value}"
    check_kind({} if given is None else given, Mapping, "effect.start", EffectError, advice)
    for name, value in (given or {}).items():
        check_name(name, "effect.start", EffectError)
        check_number(value, f"effect.start.{name}", EffectError)
    return {name: float(value) for name, value in (given or {}).items()}


def _form_at(problem: Problem, site: str, form: str, where: str) -> tuple[EffectSite, EffectForm]:
    """Return the site and the form that a user names, after a check."""
    place = parse_site(site, f"{where}: site")
    check_site(place, problem.describe(), problem.model.interface, f"{where}: site")
    return place, find_form(place.kind, form, where)


def _sized(
    problem: Problem,
    place: EffectSite,
    about: tuple[str, ...],
    missing: Sequence[FormCoefficient],
) -> dict[str, float]:
    """Return start values: the middle of each coefficient's grid in a search, if it has a grid."""
    with open_workbench(LoopRequest(problem)) as workbench:
        fitter = workbench.fitter
        space = fitter.space(FitStart(fitter.problem, {}))
        nothing = np.zeros(0)
        trajectories = fitter.trajectories(FittedModel(space, space.start, nothing, nothing))
        scales = SignalScales(trajectories, ())
        grids = {c.name: scales.grid(c, place, about) for c in missing}
    return {name: grid[len(grid) // 2] for name, grid in grids.items() if grid}


def _p(p: float) -> str:
    """Write a p-value; a value of 0 only means that it is too small for a double."""
    return f"p = {p:.2g}" if p > 0.0 else "p < 1e-300"
