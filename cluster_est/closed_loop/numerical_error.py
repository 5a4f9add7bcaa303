"""Numerical error: what the solver and its steps add to a residual, which no effect may explain.

It is measured at a fitted model: the same experiments are simulated with a finer solver.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.errors import ClusterEstError
from cluster_est.results.solver_error.finer_solver import (
    SolverScale,
    solver_scale,
    step_never_taken,
)
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.resources import Resources
from workers.messages import FloatArray, Solver


@dataclass(frozen=True)
class NumericalErrorThresholds:
    """Thresholds of the error of solver and steps, beside the noise.

    Attributes
    ----------
    small
        Error over noise up to which it is not spoken of. Theory: among some 2,500 samples its sum
        of squares is then 6 times the noise's variance, less than the choice among the candidates
        costs an effect, see `SelectionThresholds.choice_price`.
    large
        The same, above which no effect is looked for. Theory: a quarter of the noise's variance, in
        a shape that is the same in every experiment, is what an effect looks like.
    share
        Error over residual up to which a large one does not end the search, because most of the
        residual is something else. By definition: a hundredth of its squares.
    known
        Factor by which the error may be larger than measured. Theory: that between an error of
        first order and the change where its step is halved.
    loose
        Relative tolerance above which the error is spoken of in any case. By definition.
    """

    small: float = 0.05
    large: float = 0.5
    share: float = 0.1
    known: float = 2.0
    loose: float = 1e-4


NUMERICAL_ERROR = NumericalErrorThresholds()


LEAST_ORDER, MOST_ORDER = 1.0, 4.0
"""Between which the order of a step is believed: events and kinks spoil what is observed."""


@dataclass(frozen=True)
class NumericalError:
    """The error of solver and steps at a fit, measured by a finer solver.

    Attributes
    ----------
    scale
        What decides how exact the solver is.
    rms, noise, residual : (outputs,)
        Root mean squares of each output's numerical error, noise and residual, in units of its
        residual.
    squares
        Of the numerical error, summed over all residuals.
    order
        Of the step, as observed or assumed; NaN where a tolerance decides.
    why_not
        Part of a sentence: why it could not be measured; the arrays are empty then.
    beside
        Other sentences on the solver.
    """

    scale: SolverScale
    outputs: tuple[str, ...] = ()
    rms: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    squares: float = 0.0
    order: float = np.nan
    why_not: str = ""
    beside: tuple[str, ...] = ()

    @property
    def ratios(self) -> FloatArray:
        """(outputs,): over the noise; 0 where nothing is left that could be explained."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = self.rms / self.noise
        return np.where((self.rms > 0.0) & (self.residual > 0.0), ratios, 0.0)

    @property
    def ratio(self) -> float:
        """The largest of them."""
        return float(np.nanmax(self.ratios, initial=0.0))

    @property
    def explainable(self) -> float:
        """Fall of the sum of squares that an effect could owe to the numerical error."""
        return NUMERICAL_ERROR.known**2 * self.squares

    @property
    def hides_effects(self) -> bool:
        """Whether no effect can be told from it: large against the noise, and much of what is left.

        Where the residual is far larger than both, most of it is something else.
        """
        large = self.ratios > NUMERICAL_ERROR.large
        return bool(np.any(large & (self.rms > NUMERICAL_ERROR.share * self.residual)))

    @property
    def refusal(self) -> str:
        """Return why no effect is looked for, in a sentence."""
        return (
            f"{self._said}, so a missing effect cannot be distinguished from this error: set "
            f"{self._advice} first, then run again"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the reader; none where the error is small and was to be expected."""
        if self.why_not:
            cannot = (
                f"the numerical error of {self.scale.name} could not be measured: {self.why_not}; "
                "the finding may be an artefact of this error"
            )
            return (*self.beside, cannot)
        if self.hides_effects:
            why = f"the search looked for no effects, because {self._said}"
            return (*self.beside, f"{why}; {self._advice} makes this error negligible")
        if self.ratio > NUMERICAL_ERROR.small:
            said = (
                f"{self._said}; the search refuses an effect that explains no more than this "
                "error could explain"
            )
            return (*self.beside, f"{said}; {self._advice} makes this error negligible")
        if self.scale.rtol > NUMERICAL_ERROR.loose:
            said = f"{self._said}, which is negligible here"
            return (*self.beside, f"{said}; {self._advice} keeps it negligible in other cases too")
        return self.beside

    @property
    def notes_with_effects(self) -> tuple[str, ...]:
        """Sentences on the error of a model with effects; none where it is small."""
        if not self.ratio > NUMERICAL_ERROR.small:
            return ()
        refused = (
            "the search refuses a further effect that explains no more than this error could "
            "explain"
        )
        return (
            f"with the effects, {self._said}; {refused}; {self._advice} makes this error "
            "negligible",
        )

    @property
    def _said(self) -> str:
        largest = int(np.nanargmax(self.ratios))
        output = self.outputs[largest]
        figure = f"{self.ratio:.2g}" if self.ratio < 100.0 else f"{self.ratio:.0f}"
        size = f"{figure} times the noise"
        if not np.isfinite(self.ratio):  # there is none
            size = f"{self.rms[largest] / self.residual[largest]:.2g} times the remaining residual"
        how = "" if np.isnan(self.order) else f"; convergence order {self.order:.2g}"
        return f"{self.scale.name} causes an error of {size} (at {output}{how})"

    @property
    def _advice(self) -> str:
        factor = self.ratio / NUMERICAL_ERROR.small
        factor = factor if np.isfinite(factor) else 1.0 / NUMERICAL_ERROR.small
        if not self.scale.step:  # a looser tolerance than is usual is never the advice
            factor = max(factor, self.scale.rtol / NUMERICAL_ERROR.loose)
        return self.scale.advice(factor, self.order)


def observed_order(first: FloatArray, second: FloatArray, ratio: float) -> float:
    """Order of a step, from the differences of three solutions whose steps have one ratio.

    With an error C h^p the differences y(h) - y(h/q) and y(h/q) - y(h/q^2) have the ratio q^p
    (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357, doi:10.1098/rsta.1911.0009). It is
    believed between 1 and 4, and 1 where they do not fall.
    """
    sizes = [float(np.sqrt(np.add.reduce(each**2))) for each in (first, second)]
    if not sizes[1] > 0.0:
        return MOST_ORDER
    with np.errstate(divide="ignore"):
        order = np.log(sizes[0] / sizes[1]) / np.log(ratio)
    return float(np.clip(order, LEAST_ORDER, MOST_ORDER))


def extrapolated(difference: FloatArray, ratio: float, order: float) -> FloatArray:
    """Error of the coarser of two solutions, from y(h) - y(h/q) = (1 - q^-p) C h^p."""
    return np.asarray(difference / (1.0 - ratio**-order))


class _NoSolutionError(Exception):
    """A finer solver could not simulate an experiment; its text says why."""


def measure_numerical_error(
    fitter: Fitter, fitted: FittedModel, noise: FloatArray, resources: Resources
) -> NumericalError:
    """Simulate the training experiments again with a finer solver, where a fit stands.

    A step is halved, and where that changes the outputs by more than a small part of the noise,
    halved again: the order of the error shows in the second change, and the error of the whole step
    follows by extrapolation (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357,
    doi:10.1098/rsta.1911.0009); of first order it is twice the first change. A tolerance is divided
    by 100, and the longest step halved: what changes is the error itself, but for a few hundredths
    (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section II.4,
    doi:10.1007/978-3-540-78862-1).

    The simulations run one after the other in one process of their own, whatever the executor, and
    are not logged: a log is of one solver.

    Parameters
    ----------
    noise : (outputs,)
        In units of the residuals.
    """
    runs, model, description = fitter.runs, fitter.problem.model, fitter.description
    scale = solver_scale(model, description, runs)
    never = step_never_taken(model, description, runs)
    unknown = NumericalError(
        scale,
        fitter.records.outputs,
        why_not=scale.why_not,
        beside=(never,) if never else (),
    )
    if scale.why_not:
        return unknown
    try:
        error, order = _error(fitter, fitted, noise, scale, resources)
    except (_NoSolutionError, ClusterEstError) as why:
        return replace(unknown, why_not=f"the simulation with a finer solver setting fails ({why})")
    return replace(
        unknown,
        rms=_rms(fitter, error),
        noise=noise,
        residual=_rms(fitter, fitted.residuals),
        squares=float(np.add.reduce(error**2)),
        order=order,
    )


def error_with_effects(
    fitter: Fitter,
    fitted: FittedModel,
    declared: NumericalError,
    noise: FloatArray,
    resources: Resources,
) -> NumericalError:
    """Measure the numerical error of a model with effects, where a step decides it.

    A step that is short enough for the declared model may miss the kinks of an effect: between two
    communication points an input that has been changed counts as a straight line. It is that of the
    declared model where nothing was added, where a tolerance keeps the error small, or where no
    larger one can be measured.
    """
    if not fitted.added or not declared.scale.step:
        return declared
    found = measure_numerical_error(fitter, fitted, noise, resources)
    return declared if found.why_not or found.squares <= declared.squares else found


def _error(
    fitter: Fitter,
    fitted: FittedModel,
    noise: FloatArray,
    scale: SolverScale,
    resources: Resources,
) -> tuple[FloatArray, float]:
    """The numerical error of each residual, and the order of the step."""
    once = _residuals(fitter, fitted, scale.finer(), resources)
    first = fitted.residuals - once
    if not scale.step:
        return first, np.nan
    error = extrapolated(first, scale.ratio, LEAST_ORDER)
    small = NUMERICAL_ERROR.small
    noticed = np.any(_rms(fitter, error) > small * noise)
    if not noticed or not scale.can_be_finer_twice():
        return error, LEAST_ORDER
    second = once - _residuals(fitter, fitted, scale.finer(2), resources)
    if scale.fixed and float(np.add.reduce(second**2)) >= float(np.add.reduce(first**2)):
        raise _NoSolutionError(
            "shortening the fixed step a second time changes the outputs more than the first time"
        )
    order = observed_order(first, second, scale.ratio)
    return extrapolated(first, scale.ratio, order), order


def _residuals(
    fitter: Fitter, fitted: FittedModel, solver: Solver, resources: Resources
) -> FloatArray:
    """The residuals of the training experiments with another solver."""
    runs = fitter.runs
    values = fitted.space.physical(fitted.x)
    outcomes = simulate_with_solver(
        fitted.problem, runs, values, solver, "residuals", resources, beside=fitter.runner
    )
    fitter.meter.full += len(runs)
    for run, outcome in zip(runs, outcomes, strict=True):
        if not outcome.ok or outcome.residuals is None:
            raise _NoSolutionError(f"experiment {run.id!r}: {outcome.status}, {outcome.message}")
    return np.concatenate([o.residuals for o in outcomes if o.residuals is not None])


def _rms(fitter: Fitter, stacked: FloatArray) -> FloatArray:
    """Root mean square of each output, over all training experiments."""
    parts = fitter.records.by_output(stacked)
    return np.array([float(np.sqrt(np.mean(part**2))) if len(part) else 0.0 for part in parts])
