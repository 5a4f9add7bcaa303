"""Numerical error: the part of a residual that the solver and its step size cause.

No effect may explain this part. To measure it, the experiments are simulated a second time with the
fitted model and a finer solver setting.
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
    """Thresholds of the numerical error, compared with the noise.

    Attributes
    ----------
    small
        Ratio of error to noise; up to this ratio the error is not reported. Theory: with about
        2,500 samples, its sum of squares is then 6 times the variance of the noise. This is less
        than the penalty for the choice among the candidates (`SelectionThresholds.choice_price`).
    large
        Ratio of error to noise; above this ratio there is no search for effects. Theory: an error
        with a quarter of the noise's variance and the same shape in each experiment looks like an
        effect.
    share
        Ratio of error to residual; up to this ratio even a large error does not prevent the search,
        because the residual has mostly other causes. By definition: 1 % of the squared residual.
    known
        Factor by which the true error may exceed the measured error. Theory: for a first-order
        method, the error is twice the change of the outputs when the step is halved.
    loose
        Relative tolerance above which the error is always reported. By definition.
    """

    small: float = 0.05
    large: float = 0.5
    share: float = 0.1
    known: float = 2.0
    loose: float = 1e-4


NUMERICAL_ERROR = NumericalErrorThresholds()


LEAST_ORDER, MOST_ORDER = 1.0, 4.0
"""Limits of the convergence order; events and kinks can make the observed order wrong."""


@dataclass(frozen=True)
class NumericalError:
    """The numerical error of a fitted model, measured with a finer solver setting.

    Attributes
    ----------
    scale
        The setting that determines the accuracy of the solver.
    rms, noise, residual : (outputs,)
        Root mean squares of each output's numerical error, noise and residual, in the unit of the
        residual.
    squares
        Sum of the squared numerical errors of all residuals.
    order
        Convergence order of the step, observed or assumed; NaN if a tolerance sets the accuracy.
    why_not
        Part of a sentence: why the error could not be measured; the arrays are then empty.
    beside
        Other notes on the solver.
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
        """The error over the noise: (outputs,); 0 if the residual or the error is 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = self.rms / self.noise
        return np.where((self.rms > 0.0) & (self.residual > 0.0), ratios, 0.0)

    @property
    def ratio(self) -> float:
        """The largest of the `ratios`."""
        return float(np.nanmax(self.ratios, initial=0.0))

    @property
    def explainable(self) -> float:
        """The largest decrease of the sum of squares that the numerical error could cause."""
        return NUMERICAL_ERROR.known**2 * self.squares

    @property
    def hides_effects(self) -> bool:
        """Whether effects cannot be distinguished from the error.

        This is so if the error is large compared with the noise, and not small compared with the
        residual. If the residual is much larger, most of it has other causes.
        """
        large = self.ratios > NUMERICAL_ERROR.large
        return bool(np.any(large & (self.rms > NUMERICAL_ERROR.share * self.residual)))

    @property
    def refusal(self) -> str:
        """The reason why there is no search for effects, as a sentence."""
        return (
            f"{self._said}, so a missing effect cannot be distinguished from this error: "
            f"{self.remedy} first, then run again"
        )

    @property
    def remedy(self) -> str:
        """The setting of the solver that makes the error small, as in "set model.step = 0.01"."""
        return f"set {self._advice}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the error of the declared model; usually none, because the error is small."""
        if self.why_not:
            cannot = (
                f"the numerical error of {self.scale.name} could not be measured: {self.why_not}; "
                "the finding may be an artefact of this error"
            )
            return (*self.beside, cannot)
        if self.hides_effects:
            why = f"the search looked for no effects, because {self._said}"
            return (*self.beside, f"{why}; {self._remedy}")
        if self.ratio > NUMERICAL_ERROR.small:
            return (*self.beside, f"{self._said}; {MAY_BE_MISSED}; {self._remedy}")
        if self.scale.rtol > NUMERICAL_ERROR.loose:
            said = f"{self._said}, which is negligible here"
            keep = f"set {self._advice} to keep it negligible in other cases too"
            return (*self.beside, f"{said}; {keep}")
        return self.beside

    @property
    def notes_with_effects(self) -> tuple[str, ...]:
        """Notes on the error of a model with effects; none if the error is small."""
        if not self.ratio > NUMERICAL_ERROR.small:
            return ()
        return (f"in the model with effects, {self._said}; {MAY_BE_MISSED}; {self._remedy}",)

    @property
    def _remedy(self) -> str:
        return f"set {self._advice}, which makes this error negligible, and run again"

    @property
    def _said(self) -> str:
        largest = int(np.nanargmax(self.ratios))
        output = self.outputs[largest]
        figure = f"{self.ratio:.2g}" if self.ratio < 100.0 else f"{self.ratio:.0f}"
        size = f"{figure} times the noise"
        if not np.isfinite(self.ratio):  # there is no noise
            size = f"{self.rms[largest] / self.residual[largest]:.2g} times the remaining residual"
        return f"{self.scale.name} causes an error of {size} in output {output}"

    @property
    def _advice(self) -> str:
        factor = self.ratio / NUMERICAL_ERROR.small
        factor = factor if np.isfinite(factor) else 1.0 / NUMERICAL_ERROR.small
        if not self.scale.step:  # never advise a tolerance looser than usual
            factor = max(factor, self.scale.rtol / NUMERICAL_ERROR.loose)
        return self.scale.advice(factor, self.order)


MAY_BE_MISSED = (
    "an effect that improves the fit by no more than this error could is not accepted, so small "
    "effects may be missed"
)


def observed_order(first: FloatArray, second: FloatArray, ratio: float) -> float:
    """Return the convergence order from the differences of solutions with steps h, h/q and h/q^2.

    With an error C h^p, the differences y(h) - y(h/q) and y(h/q) - y(h/q^2) have the ratio q^p
    (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357, doi:10.1098/rsta.1911.0009). The
    order is limited to 1 to 4. It is 1 if the second difference is not smaller than the first.
    """
    sizes = [float(np.sqrt(np.add.reduce(each**2))) for each in (first, second)]
    if not sizes[1] > 0.0:
        return MOST_ORDER
    with np.errstate(divide="ignore"):
        order = np.log(sizes[0] / sizes[1]) / np.log(ratio)
    return float(np.clip(order, LEAST_ORDER, MOST_ORDER))


def extrapolated(difference: FloatArray, ratio: float, order: float) -> FloatArray:
    """Return the error of the coarser of two solutions: y(h) - y(h/q) = (1 - q^-p) C h^p."""
    return np.asarray(difference / (1.0 - ratio**-order))


class _NoSolutionError(Exception):
    """A finer solver setting failed to simulate an experiment; the text says why."""


def measure_numerical_error(
    fitter: Fitter, fitted: FittedModel, noise: FloatArray, resources: Resources
) -> NumericalError:
    """Measure the numerical error of a fitted model, with a finer solver setting.

    A fixed step is halved. If the outputs then change by more than a small part of the noise, it is
    halved again. The second change shows the convergence order, and extrapolation gives the error
    of the original step (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357,
    doi:10.1098/rsta.1911.0009). For a first-order method, this error is twice the first change.

    A tolerance is divided by 100, and the longest step is halved. The change of the outputs then
    equals the error within a few per cent (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary
    Differential Equations I, section II.4, doi:10.1007/978-3-540-78862-1).

    The simulations run one after the other in a separate process, with any executor. They are not
    logged, because a log is for only one solver setting.

    Parameters
    ----------
    noise : (outputs,)
        Noise of each output, in units of the residuals.
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
    """Measure the numerical error of a model with effects, if a step size determines it.

    A step that is short enough for the declared model may be too long for an effect with kinks,
    because a changed input is interpolated linearly between two communication points. The error of
    the declared model is returned if there are no effects, if a tolerance determines the error, or
    if the measured error is not larger.
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
    """Return the numerical error of each residual, and the convergence order of the step."""
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
    """Return the residuals of the training experiments with another solver setting."""
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
    """Return the root mean square of each output over all training experiments."""
    parts = fitter.records.by_output(stacked)
    return np.array([float(np.sqrt(np.mean(part**2))) if len(part) else 0.0 for part in parts])
